"""What accuracy costs in time: settings tried under one clock, and the Pareto front.

    python -m experiments.accuracy_time                   # the built-in scene, all axes
    python -m experiments.accuracy_time CAPTURE --axes preset gaussians --jobs 4
    python -m experiments.accuracy_time --axes elastic samples --seeds 3 --budget 60
    python -m experiments.accuracy_time --axes preset --check baseline.json

Every axis changes one thing in a base, a -small preset. Each setting is trained in a
process of its own over a share of its preset's steps, all settings of the first seed,
then of the next, so that slow hours hit all alike. Prints a line for each setting
(against its base: quality, and time as a ratio), writes accuracy_time.json and the
fronts as front.png (PSNR against training and rendering time) and fronts.png (every
quality against every cost). What is finished is kept in --out: the same command goes on
where it was stopped, or where --budget ended it.
"""

import dataclasses
import pathlib
from typing import Literal

from experiments import cli
from experiments.ablate import settings as ablate
from experiments.accuracy_time.axes import AXES
from nerfies_jax import console
from nerfies_jax.runs import platform


@dataclasses.dataclass(frozen=True)
class AccuracyTime:
    """Try settings on a capture; without one, on the built-in scene."""

    source: cli.Source = cli.NamedSource()
    axes: tuple[str, ...] = tuple(AXES)
    """What to vary."""
    share: float = 0.33
    """Steps of every run as a share of its preset's own; schedules stretch with it."""
    seeds: int = 1
    """From two on, differences are held against their spread."""
    jobs: int = 1
    """Settings to train at once, each on one core; times of jobs side by side are
    longer, and compare among themselves."""
    budget: float | None = None
    """Minutes after which no run is begun that may not end in time."""
    out: pathlib.Path | None = None
    """Folder of results (default: runs/accuracy_time-...); may hold finished runs."""
    check: pathlib.Path | None = None
    """An earlier accuracy_time.json: says what got worse since, exit code 1 if any."""
    frames: int = 6
    """Held-out frames to render, evenly over the time."""
    set: cli.Overrides = ()
    """Fields that are changed in every setting, as rays=256."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Where to compute."""

    def __post_init__(self):
        wrong = [name for name in self.axes if name not in AXES]
        if wrong or not self.axes:
            raise ValueError(
                f"--axes {' '.join(wrong) or '(none)'}: choose from {', '.join(AXES)}"
            )
        if not 0 < self.share <= 10:
            raise ValueError(f"--share {self.share}: above 0, 1 is the preset's length")

    @property
    def arms(self) -> tuple[str, ...]:
        """Every setting of the axes once, bases first: a cut run keeps them."""
        chosen = [AXES[name] for name in self.axes]
        bases = [axis.base for axis in chosen]
        return tuple(dict.fromkeys([*bases, *(n for a in chosen for n in a.settings)]))


@cli.command(AccuracyTime)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        from nerfies_jax.measure import baselines

        before = None
        if args.check is not None:
            before = baselines.read(args.check, "accuracy_time.json")
        job = _job(args)
    from experiments.ablate import pool
    from experiments.accuracy_time import report

    failed = pool.run(job)
    (budget,) = job.budgets
    finished = job.finished(budget)
    worse, result = [], None
    if finished:
        metrics = report.write(job, args, finished)
        result = cli.stored(job.out / "accuracy_time.json")
        if before is not None:
            worse = baselines.changes(metrics, before)
            console.say("\n".join(worse) or f"nothing is worse than in {args.check}")
    missing = len(job.tasks()) - len(finished)
    if missing:
        console.say(
            f"{missing} of {len(job.tasks())} runs are not there; the same command "
            "goes on"
        )
    return cli.Ended(result, 1 if failed or worse else 0)


def _job(args):
    """The runs as an ablation of the suite "settings", each in its own process."""
    folder = args.source.capture
    source = cli.plain(args.source).scene if folder is None else folder.name
    out = args.out or pathlib.Path("runs", f"accuracy_time-{source}")
    ablation = ablate.Ablate(
        suite="settings",
        arms=args.arms,
        source=cli.plain(args.source),
        share=args.share,
        seeds=args.seeds,
        jobs=args.jobs,
        out=out,
        budget=args.budget,
        frames=args.frames,
        set=args.set,
        device=args.device,
    )
    ablate.check(ablation)
    platform.start_jax(args.device)
    from experiments.ablate.job import Job

    return Job(ablation)


if __name__ == "__main__":
    main()
