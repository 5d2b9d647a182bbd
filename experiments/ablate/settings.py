"""Options of an ablation, without JAX."""

import dataclasses
import pathlib
from typing import ClassVar, Literal

from experiments import cli
from experiments.ablate import suites
from nerfies_jax.runs.config import CaptureSource


@dataclasses.dataclass(frozen=True)
class Ablate:
    """Compare ways to reconstruct a moving scene with and without their parts."""

    GROUPS: ClassVar = {
        "arms": ("suite", "arms", "set"),
        "training": ("steps", "seconds", "clock", "seeds", "seed"),
        "measuring": ("frames", "tracks"),
    }

    suite: Literal["fields", "tracked", "poses", "sonata", "moba", "presets"] = "fields"
    """Methods to compare: radiance fields, the parts of splats-tracked-small, pose
    refinement, the ablations of Sonata or MoBa-GS, or every small preset."""
    arms: tuple[str, ...] = ()
    """Methods of the suite (default: all)."""
    source: cli.SourceOptions = CaptureSource()
    steps: int | None = None
    """Steps of training of every arm (default: the presets' own)."""
    seconds: float | None = None
    """Seconds of training of every arm instead, or, with --steps, as well: each gets
    the steps that it can make in this time here, and its schedules stretch to them."""
    clock: Literal["wall", "processor"] = "wall"
    """Whose seconds --seconds are: the processor's are those of all threads, and what
    else the machine does is not in them."""
    seeds: int | None = None
    """Number of seeds (default: 1 for fields, otherwise 3). With two or more,
    differences are compared with their spread."""
    seed: int | None = None
    """Train this seed alone and report nothing: one share of a run over several
    machines or processes."""
    jobs: int = 1
    """Methods to train at once, each in a process with one core. A single one uses all
    cores."""
    out: pathlib.Path | None = None
    """Folder of results (default: runs/ablation-...). It may hold finished arms."""
    budget: float | None = None
    """Minutes after which no arm is begun that may not end in time."""
    frames: int = 6
    """Held-out frames to render, evenly over the time."""
    tracks: int = 200
    """Points to follow, at most."""
    set: cli.Overrides = ()
    """Fields changed in every arm, as strategy.cap_max=5000 template.depth=4."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Device to compute on."""

    @property
    def all_seeds(self) -> range:
        """The seeds of the whole run."""
        count = suites.named(self.suite).seeds if self.seeds is None else self.seeds
        return range(count)


def check(args: Ablate) -> None:
    """Raise ValueError for what cannot be run."""
    least = min(args.frames, args.tracks, args.jobs, len(args.all_seeds))
    limits = (args.budget, args.seconds, args.steps)
    if least < 1 or not all(limit is None or limit > 0 for limit in limits):
        raise ValueError(
            "--seeds, --frames, --tracks, --jobs, --budget, --seconds and --steps are "
            f"positive, got {args.seeds}, {args.frames}, {args.tracks}, {args.jobs}, "
            f"{args.budget}, {args.seconds} and {args.steps}"
        )
    if args.seed is not None and not (args.seed >= 0 and args.jobs == 1):
        raise ValueError(
            f"--seed {args.seed}: one seed from 0 on, in one process (--jobs 1)"
        )
    for name in args.arms:
        if name not in suites.named(args.suite).arms:
            raise ValueError(
                f"--arms {name}: in --suite {args.suite} there are "
                + ", ".join(suites.named(args.suite).arms)
            )
