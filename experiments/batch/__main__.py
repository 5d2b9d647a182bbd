"""Reconstruct many captures with presets and seeds, on one machine or a cluster.

    nerfies batch CAPTURES ... --preset splats-tracked-small nerf-small
    nerfies batch clips/*.mp4 --seeds 3 --jobs 4 --memory-gb 8 --hours 1
    nerfies batch CAPTURES ... --engine slurm --slurm partition=gpu

Every run is one of `nerfies reconstruct`, in its own process and folder. A run that
fails is named with its log, and the others go on. A run that is killed or preempted
continues from its last checkpoint, and the same command continues an interrupted batch.
All runs share the caches of compiled programs and of preprocessing, and the cameras of
a video are estimated once. OUT/index.html and OUT/batch.json have the results.
"""

import dataclasses
import math
import pathlib
import shutil
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import tyro

from experiments import cli, options, records
from experiments.batch import engines
from experiments.batch import task as tasks
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.runs import representations
from nerfies_jax.runtime import console

STORED = "batch.json"
Presets = Annotated[
    tuple[str, ...],
    options.Known(representations.PRESETS),
    tyro.conf.arg(metavar="NAME ..."),
]
Assignments = Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE ...")]


@dataclasses.dataclass(frozen=True)
class Batch:
    """Reconstruct many captures, videos or folders of images."""

    GROUPS: ClassVar = {
        "training": ("preset", "set", "steps", "seconds", "seeds"),
        "images": ("max_side", "heldout"),
        "execution": (
            *("engine", "jobs", "scheduler", "slurm", "memory_gb", "hours"),
            "retries",
        ),
    }

    captures: cli.Positional[tuple[pathlib.Path, ...]] = ()
    """Captures, videos or folders of images, as for nerfies reconstruct."""
    preset: Presets = ()
    """Presets to train on every capture (default: chosen by the tracks of each)."""
    set: cli.Overrides = ()
    """Fields changed in every preset, as for nerfies reconstruct."""
    steps: int | None = None
    """Steps of training of every run (default: the presets' own)."""
    seconds: float | None = None
    """Seconds of training of every run, without compilation, instead."""
    seeds: int = 1
    """Number of seeds, from 0 on."""
    max_side: int | None = None
    """Longest side of the images in pixels. Larger images are read at lower
    resolution."""
    heldout: str | None = None
    """Frames to hold out: n for every n-th, or the name of a split."""
    engine: Literal["local", "dask", "slurm"] = "local"
    """local: processes of this machine. dask: workers of a Dask cluster. slurm: an
    array of Slurm jobs. The last two need the extra batch."""
    jobs: int = 1
    """Runs at a time. On this machine, two or more get one core each, and a single one
    uses all cores."""
    scheduler: str | None = None
    """Address of the scheduler of a running Dask cluster, tcp://HOST:8786, say
    (default: as many workers on this machine as --jobs)."""
    slurm: Assignments = ()
    """Options of sbatch, partition=gpu gres=gpu:1 cpus_per_task=8, say."""
    memory_gb: float | None = None
    """Memory of one run in GB. A run that uses more is ended."""
    hours: float | None = None
    """Time of one run in hours, with compilation. A run that takes longer saves its
    state and ends, and the same command continues it."""
    retries: int = 1
    """How often a run that was killed or preempted is continued."""
    out: pathlib.Path = pathlib.Path("runs/batch")
    """Folder for the runs, index.html and batch.json."""

    def __post_init__(self):
        if not self.captures:
            raise ValueError("no captures: name one folder or video at least")
        if len({path.absolute() for path in self.captures}) < len(self.captures):
            raise ValueError("a capture is named twice: name each of them once")
        for name, least in (("seeds", 1), ("jobs", 1), ("steps", 1), ("retries", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"--{name} {value}: at least {least}")
        for name in ("seconds", "memory_gb", "hours"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                option = name.replace("_", "-")
                raise ValueError(f"--{option} {value:g}: must be above 0 and finite")
        cli.check_max_side(self.max_side)
        for name in self.preset:
            if name not in representations.PRESETS:
                choices = known_names(name, representations.PRESETS)
                raise ValueError(f"--preset {name}: no such preset; {choices}")
        if self.scheduler is not None and self.engine != "dask":
            raise ValueError(f"--scheduler {self.scheduler}: only with --engine dask")
        if self.slurm and self.engine != "slurm":
            raise ValueError(f"--slurm {self.slurm[0]}: only with --engine slurm")
        for each in self.slurm:
            if "=" not in each:
                raise ValueError(
                    f"--slurm {each}: write KEY=VALUE, as in partition=gpu"
                )

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of every run, which do not change when a batch continues."""
        names = ("set", "steps", "seconds", "max_side", "heldout")
        values = {name: getattr(self, name) for name in names}
        return {**values, "set": list(self.set)}

    @property
    def limits(self) -> tasks.Limits:
        """Limits of one run."""
        return tasks.Limits(
            math.inf if self.memory_gb is None else 1e9 * self.memory_gb,
            math.inf if self.hours is None else 3600 * self.hours,
        )


class Run(NamedTuple):
    """One run: a capture, a preset and a seed."""

    capture: str  # name in the table
    preset: str
    seed: int
    task: tasks.Task


@cli.command(Batch)
def main(args):
    """Run what is missing and write the results. Failed runs end with exit code 1."""
    with cli.user_errors():
        for path in args.captures:
            if not path.exists():
                raise ValueError(f"{path}: no such file or folder; check the path")
        for preset in args.preset or (None,):
            representations.cores(preset, args.set)  # refuses wrong settings
        engine = _engine(args)
        args.out.mkdir(parents=True, exist_ok=True)
        _check_settings(args)
        runs = plan_runs(args)
    missing_tasks = [run.task for run in runs if tasks.result(run.task) is None]
    endings = {}
    for task, ending in engines.execute(missing_tasks, engine, args.retries):
        result = tasks.result(task)
        if result is None:
            endings[task] = ending
            console.say(tasks.failure(task, ending))
        else:
            console.say(f"{task.name}: {tasks.summary(result.metrics)}")
    record = keep(args, runs, endings)
    return cli.Ended(record, 1 if endings else 0)


def _engine(args) -> engines.Engine:
    """Return the engine, after checks that its packages are installed."""
    if args.engine == "dask":
        engines.extras.check("distributed", engines.EXTRA)
        return lambda each: engines.dask(each, args.jobs, args.scheduler)
    if args.engine == "slurm":
        engines.extras.check("submitit", engines.EXTRA)
        if shutil.which("sbatch") is None:
            raise ValueError(
                "--engine slurm: there is no sbatch here; use a login node of a cluster"
            )
        folder, words = (
            args.out.absolute() / "slurm",
            (w.partition("=") for w in args.slurm),
        )
        options = {key: value for key, _, value in words}
        return lambda each: engines.slurm(each, folder, args.jobs, options)
    return lambda each: engines.local(each, args.jobs)


def _check_settings(args):
    """Raise ValueError if the folder holds a batch with other settings."""
    record = records.rows(args.out / STORED)
    earlier = record.get("settings", args.settings)
    changed_names = [
        name for name in args.settings if earlier[name] != args.settings[name]
    ]
    if changed_names:
        name = changed_names[0]
        raise ValueError(
            f"--out {args.out}: holds a batch with {name}={earlier[name]}, and this "
            f"one has {args.settings[name]}; choose another folder"
        )
    records.write(args.out / STORED, {**record, "settings": args.settings})


def plan_runs(args: Batch) -> list[Run]:
    """List all runs, those of the first seed first.

    Args:
      args: Options.

    Returns:
      The runs.
    """
    from nerfies_jax.runs import preparation  # loads JAX

    runs = []
    out = args.out.absolute()
    names = dict(zip(args.captures, unique_names(args.captures), strict=True))
    clips = {path for path in args.captures if preparation.needed(path)}
    images = [] if args.max_side is None else ["--max-side", str(args.max_side)]
    images += [] if args.heldout is None else ["--heldout", args.heldout]
    for seed in range(args.seeds):
        for path, name in names.items():
            source = path.absolute()
            prepare: tuple[str, ...] = ()
            if path in clips:
                kind = "video" if path.is_file() else "images"
                capture = out / name / "capture"
                prepare, source = (kind, str(source), str(capture)), capture
            for preset in args.preset or (None,):
                label = preset or "default"
                task = tasks.Task(
                    f"{name}, {label}, seed {seed}",
                    out / name / f"{label}-{seed}",
                    tasks.options(
                        [str(source), *images], preset, args.set, seed, args.steps
                    ),
                    args.seconds,
                    one_core=args.jobs > 1 and args.engine != "slurm",
                    limits=args.limits,
                    prepare=prepare,
                )
                runs.append(Run(name, label, seed, task))
    return runs


def unique_names(paths: tuple[pathlib.Path, ...]) -> list[str]:
    """Name files by as many parts of their paths as it takes to tell them apart."""
    parts = [path.absolute().with_suffix("").parts for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["-".join(each[-count:]).lstrip("/") for each in parts]
        if len(set(names)) == len(names):
            return names
    return ["-".join(path.absolute().parts).lstrip("/") for path in paths]


def keep(
    args: Batch, runs: list[Run], endings: dict[tasks.Task, tasks.Ending]
) -> dict[str, Any]:
    """Write OUT/batch.json and OUT/index.html, and print the table.

    Args:
      args: Options.
      runs: All runs.
      endings: How the tasks ended that failed.

    Returns:
      What is stored: rows of the table, and failures.
    """
    from experiments.batch import page
    from experiments.benchmark import verdicts

    path = args.out / STORED
    results = {run: tasks.result(run.task) for run in runs}
    complete_results = {
        run: result for run, result in results.items() if result is not None
    }
    rows = []
    for capture, preset in dict.fromkeys((run.capture, run.preset) for run in runs):
        these = [run for run in complete_results if run[:2] == (capture, preset)]
        rows.append(
            {
                "capture": capture,
                "preset": preset,
                "trained": sorted({complete_results[run].preset for run in these}),
                "runs": [
                    tasks.display_path(run.task.folder, args.out) for run in these
                ],
                **verdicts.summary([complete_results[run].metrics for run in these]),
            }
        )
    failures = [
        {
            "run": task.name,
            "code": ending.code,
            "reason": ending.reason,
            "log": tasks.display_path(task.log, args.out),
        }
        for task, ending in endings.items()
    ]
    record = {"settings": args.settings, "rows": rows, "failures": failures}
    records.write(
        path, record, *(result.machine for result in complete_results.values())
    )
    page.write(args.out / "index.html", record)
    console.say(page.table(record))
    if failures:
        console.say(f"{len(failures)} of {len(runs)} runs failed")
    console.say(f"stored in {path} and {args.out / 'index.html'}")
    return record


if __name__ == "__main__":
    main()
