"""What each part of a method is worth: the whole of it against itself without the part.

    python -m experiments.ablate                                  # radiance fields
    python -m experiments.ablate --suite sonata --jobs 4          # Sonata's ablation
    python -m experiments.ablate --suite moba --steps 2000 --seconds 120 --jobs 4
    python -m experiments.ablate --arms static nerfies --scene fast --budget 30
    python -m experiments.ablate --suite sonata --capture FOLDER  # no truth: PSNR, SSIM

All arms of a suite learn the same frames from the same seeds, over as many steps
(--steps), as much time (--seconds), or first the one and then the other; the last
iterate counts. Prints a table and what it says of the claims, writes ablation.json and
ablation.png. Finished arms are kept in --out: the same command goes on where it was
stopped.
"""

import dataclasses
import pathlib
from typing import Literal

from experiments import settings as run_settings
from experiments.ablate_suites import SUITES


@dataclasses.dataclass(frozen=True)
class Ablate:
    """Compare ways to reconstruct a moving scene with and without their parts."""

    suite: Literal["fields", "sonata", "moba", "settings", "advice"] = "fields"
    """Radiance fields, the ablations of Sonata or MoBa-GS, the settings of
    experiments.accuracy_time, or what experiments.inspect_scene can advise."""
    arms: tuple[str, ...] = ()
    """Which arms of the suite (default: all)."""
    scene: str = "default"
    """Which built-in scene, where no capture is given."""
    capture: pathlib.Path | None = None
    """Folder of a real capture: nothing but its held-out pictures is known of it."""
    factor: int | None = None
    """Read the capture's pictures at 1/FACTOR of their size."""
    max_side: int | None = None
    """Read the capture's pictures with no side longer than this, in pixels."""
    heldout: str | None = None
    """Frames of the capture to judge by: n for every n-th, or the name of a split."""
    steps: int | None = None
    """Steps of training of every arm (default: the presets' own)."""
    share: float | None = None
    """Steps of training of every arm as a share of its preset's own."""
    seconds: float | None = None
    """Seconds of training of every arm instead, or, with --steps, as well: each gets
    the steps that it can make in this time here, and its schedules stretch to them."""
    seeds: int | None = None
    """How many seeds (default: 1 for fields, otherwise 3); from two on, differences
    are held against their spread."""
    seed: int | None = None
    """Train this seed alone and report nothing: one share of a run over several
    machines or processes."""
    jobs: int = 1
    """Arms to train at once, each in a process with one core."""
    out: pathlib.Path | None = None
    """Folder of results (default: runs/ablation-...). It may hold finished arms."""
    budget: float | None = None
    """Minutes after which no arm is begun that may not end in time."""
    frames: int = 6
    """Held-out frames to render, evenly over the time."""
    tracks: int = 200
    """Points to follow, at most."""
    set: tuple[str, ...] = ()
    """Fields changed in every arm, as densification.cap_max=5000 template.depth=4."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Where to compute."""

    @property
    def all_seeds(self) -> range:
        """The seeds of the whole run."""
        count = SUITES[self.suite].seeds if self.seeds is None else self.seeds
        return range(count)


def main(arguments=None):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with run_settings.user_errors():
        asked = run_settings.parse(Ablate, arguments)
        check(asked)
        arms = SUITES[asked.suite].arms
        names = asked.arms or tuple(arms)
        threads = {run_settings.threads_for(arms[name].preset) for name in names}
        run_settings.start_jax(asked.device, "all" if "all" in threads else "one")
        from experiments.ablate_job import Job

        job = Job(asked)
    failed = job.run()
    if asked.seed is None:
        _report(job)
    raise SystemExit(1 if failed else 0)


def check(asked: Ablate) -> None:
    """Raise ValueError for what cannot be run."""
    least = min(asked.frames, asked.tracks, asked.jobs, len(asked.all_seeds))
    limits = (asked.budget, asked.seconds, asked.steps, asked.share)
    if least < 1 or not all(limit is None or limit > 0 for limit in limits):
        raise ValueError(
            "--seeds, --frames, --tracks, --jobs, --budget, --seconds, --steps and "
            f"--share are positive, got {asked.seeds}, {asked.frames}, {asked.tracks}, "
            f"{asked.jobs}, {asked.budget}, {asked.seconds}, {asked.steps} and "
            f"{asked.share}"
        )
    if asked.share is not None and asked.steps is not None:
        raise ValueError("--steps and --share say the same thing: give one of them")
    if asked.seed is not None and not (asked.seed >= 0 and asked.jobs == 1):
        raise ValueError(
            f"--seed {asked.seed}: one seed from 0 on, in one process (--jobs 1)"
        )
    for name in asked.arms:
        if name not in SUITES[asked.suite].arms:
            raise ValueError(
                f"--arms {name}: in --suite {asked.suite} there are "
                + ", ".join(SUITES[asked.suite].arms)
            )


def _report(job):
    for budget in job.budgets:
        finished = job.finished(budget)
        if finished:
            from experiments import ablate_report

            ablate_report.write(job, budget, finished)
    missing = job.missing()
    if missing:
        print(
            f"{len(missing)} arms and seeds are left: "
            + ", ".join(f"{name} {seed}" for name, seed in missing)
            + f"; the same command with --out {job.out} goes on"
        )


if __name__ == "__main__":
    main()
