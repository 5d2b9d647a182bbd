"""Time of training steps, effects, the rasterizer and the default command.

    nerfies study speed steps                       # every small preset
    nerfies study speed effects --presets sonata-small
    nerfies study speed raster 10000@256x256 --reference PATH/run.py
    nerfies study speed job --compare CHECKOUT
    nerfies study speed steps --check BEFORE/speed.json

`steps` times every preset in two fresh processes, one that sees one core and one with
the cores that its step is made for. `job` times the README's first command with empty
caches, and `--compare` that of another checkout between two of this one. `raster` times
the rasterizer, and `--reference` another one on the same scene. Times of these three
are wall clock, so leave the machine idle. `effects` is described on its own page.

Earlier results in --out stay where they are not repeated. `--check` compares with an
earlier file and ends with exit code 1 if a number is worse than its tolerance: a
quarter of a time, half of a compilation, a tenth of memory, 0.15 of a ratio to the
other rasterizer, and half a decibel.
"""

import concurrent.futures
import dataclasses
import multiprocessing
import os
import pathlib
from typing import Any, Literal

from experiments import cli, records
from experiments.speed import raster
from nerfies_jax.runs import representations
from nerfies_jax.runtime import children, console

STORED, EFFECTS = "speed.json", "effect_cost.json"


@dataclasses.dataclass(frozen=True)
class _Stored:
    out: pathlib.Path = pathlib.Path("runs/speed")
    """Folder of the results."""
    check: pathlib.Path | None = None
    """An earlier file of results to compare with."""


@dataclasses.dataclass(frozen=True)
class Steps(_Stored):
    """Time training steps, compilation and rendering of presets."""

    presets: tuple[str, ...] = ()
    """Presets to time (default: all small ones)."""

    def __post_init__(self):
        cli.check_presets(self.presets)


@dataclasses.dataclass(frozen=True)
class Effects(_Stored):
    """Measure the cost of each effect of presets."""

    presets: tuple[str, ...] = ()
    """Presets to measure (default: all small ones with effects of their own)."""
    at: float = 0.4
    """Share of a run's steps before the step that is measured."""
    rows: int | None = None
    """Initial Gaussians of a scene of splats (default: the preset's)."""
    rays: int | None = None
    """Rays of a step of a radiance field (default: the preset's)."""
    repeats: int = 5
    """Timed calls of every program. The table has the medians."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Device to compute on."""

    def __post_init__(self):
        cli.check_presets(self.presets)
        if not 0 <= self.at < 1:
            raise ValueError(f"--at {self.at}: a share of the steps, from 0 to below 1")
        for name in ("rows", "rays", "repeats"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name} {value} must be at least 1")


@dataclasses.dataclass(frozen=True)
class Raster(_Stored):
    """Time the rasterizer and its gradient on one core."""

    cases: cli.Positional[tuple[str, ...]] = raster.CASES
    """Gaussians and image sizes, as 10000@256x256."""
    reference: pathlib.Path | None = None
    """Script of another rasterizer to time on the same scenes."""

    def __post_init__(self):
        for case in self.cases:
            raster.parse_case(case)


@dataclasses.dataclass(frozen=True)
class Job(_Stored):
    """Time the README's first command, from empty caches to its report."""

    compare: pathlib.Path | None = None
    """Checkout of another revision of the library to compare with."""


@cli.command(Steps | Effects | Raster | Job)
def main(args):
    """Measure and store. Wrong input ends with exit code 2."""
    from nerfies_jax.metrics import baselines

    before = None
    with cli.user_errors():
        check = getattr(args, "check", None)
        if check is not None:
            before = baselines.read(check, check.name)
        _check_files(args)
        args.out.mkdir(parents=True, exist_ok=True)
        path = MEASURES[type(args)](args)
    console.say(f"stored in {path}")
    record, worse = cli.stored(path), []
    if before is not None:
        from nerfies_jax.metrics import clock

        worse = baselines.changes([*clock.read_metrics(path).values()], before)
        console.say("\n".join(worse) or f"nothing is worse than in {check}")
    return cli.Ended(record, 1 if worse else 0)


def _check_files(args):
    """Raise ValueError if a file or folder that options name does not exist."""
    reference = getattr(args, "reference", None)
    if reference is not None and not reference.is_file():
        raise ValueError(f"{reference}: no such file")
    checkout = getattr(args, "compare", None)
    if checkout is not None and not (checkout / "experiments").is_dir():
        raise ValueError(f"--compare {checkout}: no checkout of this library")


def keep(
    path: pathlib.Path, machine: dict, keys: tuple[str, ...], record: Any
) -> pathlib.Path:
    """Put a record in its place in speed.json, which keeps all others.

    Args:
      path: The file.
      machine: Description of the machine.
      keys: Place of the record.
      record: The record.

    Returns:
      The file.
    """
    from experiments.speed import tolerances
    from nerfies_jax.metrics import clock

    content = records.rows(path)
    place = content
    for key in keys[:-1]:
        place = place.setdefault(key, {})
    place[keys[-1]] = record
    content["metrics"] = clock.metric_rows(tolerances.metrics(content))
    records.write(path, content, machine)
    return path


def _apart(work, *arguments):
    """Return the work's result from a fresh process."""
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(
        1, context, children.end_with_parent, (os.getpid(),)
    ) as pool:
        return pool.submit(work, *arguments).result()


def _steps(args):
    from experiments.speed import steps

    small = tuple(n for n in representations.PRESETS if n.endswith("-small"))
    _apart(steps.prepare)
    for preset in args.presets or small:
        for cores in ("one", "all"):
            record = _apart(steps.measure, preset, cores == "all")
            machine, keys = record.pop("machine"), ("presets", preset, cores)
            keep(args.out / STORED, machine, keys, record)
            console.say(f"{preset}, {cores}: {record['step_ms']:.1f} ms per step")
    return args.out / STORED


def _job(args):
    from experiments.speed import steps

    commands = {("job",): None}
    if args.compare is not None:
        places = {"first": None, "beside": args.compare, "again": None}
        commands |= {("jobs", name): checkout for name, checkout in places.items()}
    for keys, checkout in commands.items():
        record = steps.default_command(checkout)
        machine = record.pop("machine")
        keep(args.out / STORED, machine, keys, record | {"cpu": machine["cpu"]})
        console.say(f"{record['revision']}: {record['seconds']:.0f} s")
    return args.out / STORED


def _raster(args):
    record = _apart(raster.measure, args.cases, args.reference)
    rows = {"rows": record["rows"]}
    return keep(args.out / STORED, record["machine"], ("raster",), rows)


def _effects(args):
    from experiments.speed import effects

    return effects.measure_all(args, args.out / EFFECTS)


MEASURES = {
    Steps: _steps,
    Effects: _effects,
    Raster: _raster,
    Job: _job,
}

if __name__ == "__main__":
    main()
