"""Quality of methods over seeds: the default command, presets, ablations.

    nerfies study benchmark                            # the default command
    nerfies study benchmark CAPTURE --max-side 256
    nerfies study benchmark --preset nerfies-small --set elastic=none
    nerfies study benchmark --suite sonata --steps 900 --jobs 2
    nerfies study benchmark --suite presets --seconds 90
    nerfies study benchmark --suite curves --seeds 2 --jobs 2

Every run is one of `nerfies reconstruct`, in its own process and folder. The
methods of a suite train on the same frames with the same seeds, for the same number of
steps (`--steps`) or the same time (`--seconds`), and the final state is evaluated. The
seed determines the initial model and the order of the frames, and the camera path of a
built-in scene. The suite `curves` compares quality over processor time: each of its
methods has its own number of steps, which take about the same time. A claim of a suite
is judged by the difference between two methods and its spread over the seeds. Two
baselines are reported: the mean of the two neighboring training images, and the run's
own renders averaged over time.

The same command continues interrupted runs, and other results in OUT/benchmark.json
stay. `nerfies compare` draws curves and images of the run folders.
"""

import dataclasses
import pathlib
import re
import shlex
from collections.abc import Mapping
from typing import ClassVar, Literal, NamedTuple

from experiments import cli, records
from experiments.batch import engines
from experiments.batch import task as tasks
from experiments.benchmark import suites
from nerfies_jax.runs import representations
from nerfies_jax.runtime import console

STORED = "benchmark.json"


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Compare the quality, time and size of methods on one capture."""

    GROUPS: ClassVar = {
        "methods": ("suite", "methods", "preset", "set"),
        "training": ("steps", "seconds", "seeds"),
    }

    source: cli.Source = cli.NamedSource()
    suite: (
        Literal[
            "curves",
            "fields",
            "tracked",
            "poses",
            "sonata",
            "moba",
            "weights",
            "presets",
        ]
        | None
    ) = None
    """Methods to compare: one of each kind, over time; radiance fields; the parts of
    splats-tracked-small; pose refinement; the ablations of Sonata or MoBa-GS; weights
    that papers do not print; or every small preset (default: one method, the
    preset)."""
    methods: tuple[str, ...] = ()
    """Methods of the suite (default: all)."""
    preset: cli.Preset = None
    """Preset, without a suite (default: chosen by the tracks of the capture)."""
    set: cli.Overrides = ()
    """Fields changed in every method, as for nerfies reconstruct."""
    steps: int | None = None
    """Steps of training of every method (default: those of the suite or, if it has
    none, the presets' own)."""
    seconds: float | None = None
    """Seconds of training of every method, without compilation, instead. Schedules
    stretch with the steps that fit."""
    seeds: int = 3
    """Number of seeds, from 0 on. One seed has no spread and supports no claim."""
    jobs: int = 1
    """Runs at a time. Two or more get one core each, and a single one uses all
    cores."""
    out: pathlib.Path = pathlib.Path("runs/benchmark")
    """Folder for the runs and benchmark.json."""

    def __post_init__(self):
        for name in ("seeds", "jobs", "steps"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name} {value}: at least 1")
        if self.seconds is not None and not self.seconds > 0:
            raise ValueError(f"--seconds {self.seconds:g}: must be above 0")
        if self.suite is None and self.methods:
            raise ValueError("--methods: methods of a suite; name one with --suite")
        if self.suite is not None and self.preset is not None:
            raise ValueError("--preset and --suite: a suite has presets of its own")
        for name in self.methods:
            if name not in self.known:
                raise ValueError(
                    f"--methods {name}: in --suite {self.suite} there are "
                    + ", ".join(self.known)
                )

    @property
    def known(self) -> dict[str, str]:
        """Preset and changes of each method that can be chosen."""
        if self.suite is None:
            return {self.preset or "default": self.preset or ""}
        return suites.SUITES[self.suite].methods

    @property
    def chosen(self) -> dict[str, str]:
        """Preset and changes of the methods to compare, with those of --set."""
        names = self.methods or self.known
        return {
            name: shlex.join([*shlex.split(self.known[name]), *self.set])
            for name in names
        }

    @property
    def label(self) -> str:
        """Options of the benchmark, without the location of its files."""
        source = cli.plain(self.source)
        words = list(source.arguments)
        if source.capture is not None:
            words[0] = pathlib.Path(source.capture).name
        for name in ("preset", "suite", "steps", "seconds"):
            if getattr(self, name) is not None:
                words += [f"--{name}", f"{getattr(self, name)}"]
        return " ".join([*words, *(["--set", *self.set] if self.set else ())])


class Run(NamedTuple):
    """One run: a method and a seed."""

    method: str
    seed: int
    task: tasks.Task


@cli.command(Benchmark)
def main(args):
    """Run what is missing and store all results. Failed runs end with exit code 1."""
    with cli.user_errors():
        folder = args.source.capture
        if folder is not None and not folder.exists():
            raise ValueError(f"{folder}: no such file or folder; check the path")
        for settings in args.chosen.values():
            representations.cores(
                *suites.parse_settings(settings)
            )  # refuses wrong settings
        args.out.mkdir(parents=True, exist_ok=True)
        runs = plan_runs(args)
        failures = _execute(args, runs)
    results = {run: tasks.result(run.task) for run in runs}
    complete_results = {
        run: result for run, result in results.items() if result is not None
    }
    if complete_results:
        keep(args, complete_results)
    return cli.Ended(cli.stored(args.out / STORED), 1 if failures else 0)


def plan_runs(args: Benchmark) -> list[Run]:
    """List all runs, those of the first seed first.

    Args:
      args: Options.

    Returns:
      The runs.
    """
    stem = re.sub(r"[^\w.=]+", "-", args.label).strip("-")
    folder = args.out.absolute() / stem
    source = cli.plain(args.source).arguments
    runs = []
    for seed in range(args.seeds):
        for method, settings in args.chosen.items():
            preset, changes = suites.parse_settings(settings)
            words = tasks.options(
                source, preset, changes, seed, *_lengths(args, method)
            )
            task = tasks.Task(
                f"{method}, seed {seed}",
                folder / f"{method}-{seed}",
                words,
                args.seconds,
                one_core=args.jobs > 1,
            )
            runs.append(Run(method, seed, task))
    return runs


def _lengths(args, method):
    """Return the number of steps of a method, and those of its evaluations."""
    suite_steps = {} if args.suite is None else suites.SUITES[args.suite].steps
    if args.seconds is not None or method not in suite_steps:
        return args.steps, ()
    steps = args.steps or suite_steps[method]
    return steps, suites.evaluated_at(steps)


def _execute(args, runs):
    """Execute the missing runs and return those that failed.

    Wrong input, which is that of all runs, raises ValueError.
    """
    failures = []
    missing_tasks = [run.task for run in runs if tasks.result(run.task) is None]
    for task, ending in engines.local(missing_tasks, args.jobs):
        result = tasks.result(task)
        if result is not None:
            console.say(f"{task.name}: {tasks.summary(result.metrics)}")
            continue
        if ending.code == 2:
            raise ValueError(ending.reason.removeprefix("error: "))
        console.say(tasks.failure(task, ending))
        failures.append(task)
    return failures


def keep(args: Benchmark, results: Mapping[Run, tasks.Result]) -> None:
    """Add the results of a benchmark to OUT/benchmark.json and print its page.

    Args:
      args: Options.
      results: Results of finished runs.
    """
    from experiments.benchmark import origin, page, verdicts  # load JAX
    from nerfies_jax.training.provenance import revision

    path = args.out / STORED
    record = records.rows(path, benchmarks=dict) or {"benchmarks": {}}
    numbers = {(run.method, run.seed): one.metrics for run, one in results.items()}
    methods = {}
    for method, settings in args.chosen.items():
        of_method = {run.seed: results[run] for run in results if run.method == method}
        presets = dict.fromkeys(one.preset for one in of_method.values())
        if of_method:
            settings = (
                settings if suites.parse_settings(settings)[0] else " / ".join(presets)
            )
            methods[method] = {
                "settings": settings,
                "revision": revision(),
                "made_with": origin.of_run(of_method[min(of_method)].settings),
                **verdicts.summary([one.metrics for one in of_method.values()]),
                "curves": {
                    str(seed): verdicts.curve(one.curve)
                    for seed, one in of_method.items()
                },
            }
    claims = () if args.suite is None else suites.SUITES[args.suite].claims
    benchmark = {
        "suite": args.suite,
        "revision": revision(),
        "methods": methods,
        "claims": [one._asdict() for one in verdicts.judge(numbers, claims)],
    }
    record["benchmarks"][args.label] = benchmark
    records.write(path, record, *(result.machine for result in results.values()))
    console.say(page.page({"benchmarks": {args.label: benchmark}}))
    folders = [tasks.display_path(run.task.folder) for run in results if run.seed == 0]
    if len(folders) > 1:
        words = shlex.join(folders)
        console.say(f"images: nerfies compare {words}")
    console.say(f"stored in {path}")


if __name__ == "__main__":
    main()
