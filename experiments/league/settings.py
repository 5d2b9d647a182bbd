"""What a league is asked for, and the folder and budget of each part; no JAX."""

import dataclasses
import pathlib
from typing import Annotated, ClassVar, Literal

from experiments import cli, options
from experiments.ablate.settings import Ablate
from nerfies_jax.runs.config import CaptureSource
from nerfies_jax.runs.representations import PRESETS

SMALL = tuple(name for name in PRESETS if name.endswith("-small"))


@dataclasses.dataclass(frozen=True)
class League:
    """Train every small preset by one protocol, and hold the best against the rest."""

    GROUPS: ClassVar = {
        "pictures": ("scenes", "max_side", "heldout"),
        "training": ("presets", "budgets", "own_steps", "seeds"),
        "measuring": ("frames", "tracks"),
    }

    captures: cli.Positional[tuple[pathlib.Path, ...]] = ()
    """Folders of captures, beside the built-in scenes."""
    scenes: Annotated[tuple[str, ...], options.Known(cli.SCENES)] = (
        *("default", "fast", "topology"),
    )
    """Built-in scenes, of which the truth is known."""
    max_side: int | None = 256
    """Read the pictures of captures with no side longer than this, in pixels."""
    heldout: str | None = None
    """Which frames of captures to score: n for every n-th, or the name of a split."""
    presets: Annotated[tuple[str, ...], options.Known(SMALL)] = ()
    """Which presets (default: every one that ends in -small)."""
    budgets: tuple[float, ...] = (90.0, 300.0)
    """Processor seconds of training, without compiling: each row gets the steps that it
    can make in them, give or take a tenth, and its schedules stretch to these."""
    own_steps: bool = False
    """Also train every row over its preset's own steps."""
    seeds: int = 3
    """So many, from 0 on."""
    jobs: int = 1
    """Cells to train at once, each in a process with one core."""
    budget: float | None = None
    """Minutes after which no cell is begun that may not end in time."""
    frames: int = 6
    """Held-out frames to render, evenly over the time."""
    tracks: int = 200
    """Points to follow, at most."""
    out: pathlib.Path = pathlib.Path("runs/league")
    """Folder of results; may hold finished cells."""
    keep: bool = False
    """Begin with the numbers that are kept beside the code, keep all of them there, and
    renew docs/results/league.md."""
    anew: tuple[str, ...] = ()
    """Rows of which nothing that is kept counts any more, as after a mend: they are
    made again, over the steps that they had, whatever a second is worth here today."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Where to compute."""

    def __post_init__(self):
        least = min(self.frames, self.tracks, self.jobs, self.seeds)
        limits = [*self.budgets, *([] if self.budget is None else [self.budget])]
        if least < 1 or not all(limit > 0 for limit in limits):
            raise ValueError(
                "--seeds, --frames, --tracks, --jobs, --budget and --budgets are "
                f"positive, got {self.seeds}, {self.frames}, {self.tracks}, "
                f"{self.jobs}, {self.budget} and {self.budgets}"
            )
        if self.anew and not self.keep:
            raise ValueError(f"--anew {self.anew[0]}: is for what is kept, give --keep")
        if not self.budgets and not self.own_steps:
            raise ValueError("nothing to train: give --budgets, or --own-steps")
        unknown = [name for name in self.scenes if name not in cli.SCENES]
        if unknown:
            raise ValueError(
                f"--scenes {unknown[0]}: choose from {', '.join(cli.SCENES)}"
            )
        names = list(self.sources)
        if len(names) < len(self.captures) + len(set(self.scenes)) or not names:
            raise ValueError(
                f"scenes and captures {names}: at least one, each folder with a name "
                "of its own"
            )

    @property
    def sources(self) -> dict[str, CaptureSource]:
        """What is filmed, by the name of the scene or of the folder."""
        built_in = {name: CaptureSource(scene=name) for name in self.scenes}
        filmed = {
            folder.absolute().name: CaptureSource(
                capture=folder, max_side=self.max_side, heldout=self.heldout
            )
            for folder in self.captures
        }
        return built_in | filmed

    @property
    def limits(self) -> tuple[float | None, ...]:
        """Processor seconds, short ones first; None for the preset's own steps."""
        own = (None,) if self.own_steps else ()
        return (*sorted(set(self.budgets)), *own)

    def ablation(
        self, name: str, seconds: float | None, arms: tuple[str, ...]
    ) -> Ablate:
        """One part of the league: one film, one length of training, all rows."""
        return Ablate(
            suite="league",
            arms=arms,
            source=self.sources[name],
            seconds=seconds,
            clock="processor" if seconds is not None else "wall",
            seeds=self.seeds,
            jobs=self.jobs,
            out=self.out / name,
            frames=self.frames,
            tracks=self.tracks,
            device=self.device,
        )
