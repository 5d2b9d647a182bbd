"""Time of a step, a frame, a compilation and the main job on this machine.

    python -m experiments.speed --out speed
    python -m experiments.speed --presets splats-tracked-small --out speed
    python -m experiments.speed --job --yardstick PATH/run.py --out speed
    python -m experiments.speed --no-steps --beside CHECKOUT --out speed
    python -m experiments.speed --presets splats-tracked-small --check BEFORE/speed.json

Every preset is timed in two fresh processes, one that sees one core and one that has
the cores its steps are made for. `--job` also times the README's first command with
empty caches, and `--beside` that of another checkout, an earlier revision, between two
of ours. `--raster` times the rasterizer on cases such as 10000@256x256, and
`--yardstick` compares it with another (`experiments.speed.raster`). Times are wall
clock, so leave the machine idle. Earlier measurements stay in OUT/speed.json where they
are not repeated. `--check` compares with an earlier file. The tolerances are a quarter
of a time, half of a compilation, a tenth of memory, 0.15 of a ratio to the other
rasterizer, and half a decibel.
"""

import concurrent.futures
import dataclasses
import json
import multiprocessing
import os
import pathlib
import subprocess
import sys
import tempfile
import time

from experiments import cli, records
from experiments.speed import job, raster
from nerfies_jax.runs import representations
from nerfies_jax.runtime import children, console

STORED = "speed.json"


@dataclasses.dataclass(frozen=True)
class Speed:
    """Time presets, the main job, and the rasterizer beside another."""

    presets: tuple[str, ...] = ()
    """Presets to time (default: all small ones)."""
    steps: bool = True
    """Time their steps. Otherwise only measure what the other options ask for."""
    job: bool = False
    """Also the main job, from the command to its report."""
    beside: pathlib.Path | None = None
    """Also the main job of this checkout of the library, between two of ours."""
    raster: tuple[str, ...] = ()
    """Cases of the rasterizer to time as well (default: three with --yardstick)."""
    yardstick: pathlib.Path | None = None
    """Also the rasterizer, next to the one that this script times."""
    out: pathlib.Path = pathlib.Path("runs/speed")
    """Folder for speed.json."""
    check: pathlib.Path | None = None
    """An earlier speed.json: exit code 1 where a number is worse than its tolerance."""

    def __post_init__(self):
        cli.check_presets(self.presets)
        if self.presets and not self.steps:
            raise ValueError("--no-steps times no preset: leave --presets out")
        for case in self.raster:
            raster.parsed(case)


@cli.command(Speed)
def main(args):
    """Measure and store. Wrong input ends with exit code 2."""
    from experiments.speed import tolerances
    from nerfies_jax.metrics import baselines

    before = None
    with cli.user_errors():
        if args.check is not None:
            before = baselines.read(args.check, STORED)
        if args.beside is not None and not (args.beside / "experiments").is_dir():
            raise ValueError(f"--beside {args.beside}: no checkout of this library")
        if args.yardstick is not None and not args.yardstick.is_file():
            raise ValueError(f"--yardstick {args.yardstick}: no such file")
        args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / STORED
    small = tuple(n for n in representations.PRESETS if n.endswith("-small"))
    if args.steps:
        _keep_steps(path, args.presets or small)
    if args.job:
        _keep_job(path, ("job",), None)
    if args.beside is not None:
        jobs = {"first": None, "beside": args.beside, "again": None}
        for name, checkout in jobs.items():
            _keep_job(path, ("jobs", name), checkout)
    if args.raster or args.yardstick is not None:
        record = _apart(raster.measure, args.raster or raster.CASES, args.yardstick)
        keep(path, record["machine"], ("raster",), {"rows": record["rows"]})
    console.say(f"kept in {path}")
    stored = cli.stored(path)
    worse = []
    if before is not None:
        worse = baselines.changes(tolerances.metrics(stored or {}), before)
        console.say("\n".join(worse) or f"nothing is worse than in {args.check}")
    return cli.Ended(stored, 1 if worse else 0)


def keep(path: pathlib.Path, machine: dict, keys: tuple[str, ...], record) -> None:
    """Put a record in its place in the file, which keeps all others."""
    from experiments.speed import tolerances
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.metrics import clock

    stored = records.rows(path)
    stored["machine"] = clock.beside(machine, stored.get("machine", {}))
    inner = stored
    for key in keys[:-1]:
        inner = inner.setdefault(key, {})
    inner[keys[-1]] = record
    stored["metrics"] = clock.metric_rows(tolerances.metrics(stored))
    write_json(path, stored)


def _apart(work, *arguments):
    """The work's result, from a fresh process."""
    spawned = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(
        1, spawned, children.end_with_parent, (os.getpid(),)
    ) as pool:
        return pool.submit(work, *arguments).result()


def _keep_steps(path, presets):
    _apart(job.prepare)
    for preset in presets:
        for cores in ("one", "all"):
            record = _apart(job.measure, preset, cores == "all")
            keep(path, record.pop("machine"), ("presets", preset, cores), record)
            console.say(f"{preset}, {cores}: {record['step_ms']:.1f} ms a step")


def _keep_job(path, keys, checkout):
    record = main_job(checkout)
    machine = record.pop("machine")
    keep(path, machine, keys, record | {"cpu": machine["cpu"]})
    whose = "main job" if checkout is None else f"main job of {checkout}"
    console.say(f"{whose}: {record['seconds']:.0f} s")


def main_job(checkout: pathlib.Path | None = None) -> dict:
    """Seconds of the README's first command, with nothing kept from before.

    Of another checkout by its own code, and with its revision.
    """
    with tempfile.TemporaryDirectory() as folder:
        run = pathlib.Path(folder) / "run"
        environment = dict(children.environment(), XDG_CACHE_HOME=f"{folder}/cache")
        for name in ("JAX_COMPILATION_CACHE_DIR", "PJRT_NPROC", "NPROC"):
            environment.pop(name, None)
        if checkout is not None:
            environment["PYTHONPATH"] = str(checkout.resolve())
        command = [sys.executable, "-m", "experiments.reconstruct", "--out", str(run)]
        began = time.perf_counter()
        subprocess.run(
            command, check=True, env=environment, cwd=checkout, capture_output=True
        )
        seconds = time.perf_counter() - began
        metrics = json.loads((run / "metrics.json").read_text())
    from nerfies_jax.metrics import clock
    from nerfies_jax.training.provenance import revision

    wanted = ("train.seconds", "train.compile_seconds", "heldout.psnr")
    return {
        "seconds": seconds,
        "revision": revision(checkout),
        **{name: metrics.get(name) for name in (*wanted, "heldout.moving_psnr")},
        "machine": clock.machine(),
    }


if __name__ == "__main__":
    main()
