"""Quality of the main job over several seeds, compared with two baselines.

    python -m experiments.benchmark --out runs/benchmark
    python -m experiments.benchmark --scene fast --out runs/benchmark
    python -m experiments.benchmark CAPTURE --max-side 256 --out runs/benchmark

Each seed is one run of `experiments.reconstruct` in its own process. One run at a time
uses the cores that its preset wants. The seed determines the initial Gaussians and the
order of the frames, and the camera path of a built-in scene. Complete runs are not
repeated, and the numbers of other captures in OUT/benchmark.json stay.
"""

import concurrent.futures
import dataclasses
import multiprocessing
import os
import pathlib
import re

from experiments import cli, kept
from experiments.benchmark import job
from nerfies_jax.runs import representations
from nerfies_jax.runs.config import RunConfig
from nerfies_jax.runtime import children, console

STORED = "benchmark.json"


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Run the main job on one capture with several seeds."""

    source: cli.Source = cli.NamedSource()
    preset: cli.Preset = None
    """Preset (default: chosen by the tracks of the capture)."""
    steps: int | None = None
    """Steps of training (default: the preset's own)."""
    seconds: float | None = None
    """Train for so many seconds, without compiling, instead."""
    set: cli.Overrides = ()
    """Fields of the preset, as for experiments.reconstruct."""
    seeds: int = 3
    """So many, from 0 on."""
    jobs: int = 1
    """Runs at a time. Two or more get one core each, and a single one uses all
    cores."""
    out: pathlib.Path = pathlib.Path("runs/benchmark")
    """Folder for the runs and benchmark.json."""

    def __post_init__(self):
        for name in ("seeds", "jobs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: at least 1")


@cli.command(Benchmark)
def main(args):
    """Run all seeds and store their metrics. Wrong input ends with exit code 2."""
    with cli.user_errors():
        filmed = args.source.capture
        if filmed is not None and not filmed.exists():
            raise ValueError(f"{filmed}: no such file or folder; check the path")
        representations.cores(args.preset, args.set)  # refuses wrong settings
        args.out.mkdir(parents=True, exist_ok=True)
        label = _label(args)
        configs = {seed: _config(args, seed) for seed in range(args.seeds)}
    from nerfies_jax.runs.reconstruction import Refused

    with cli.user_errors((Refused,)):
        _run_all(args, label, configs)
    console.say(f"kept in {args.out / STORED}")
    return cli.stored(args.out / STORED)


def _run_all(args, label, configs):
    # Not forked: JAX has threads, and each run chooses its platform anew.
    spawned = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(
        args.jobs,
        spawned,
        children.end_with_parent,
        (os.getpid(),),
        max_tasks_per_child=1,
    ) as pool:
        runs = {
            pool.submit(
                job.score,
                config,
                args.out / f"{_stem(args)}-{seed}",
                args.seconds,
                alone=args.jobs == 1,
            ): seed
            for seed, config in configs.items()
        }
        try:
            for run in concurrent.futures.as_completed(runs):
                keep(args.out / STORED, label, runs[run], run.result())
                console.say(f"{label}, seed {runs[run]}: {_line(run.result())}")
        except BaseException:  # what refuses one seed refuses the others
            pool.shutdown(cancel_futures=True)
            raise


def keep(path: pathlib.Path, label: str, seed: int, scored: dict) -> None:
    """Add one run to the kept numbers, in the place of an older one."""
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.metrics import clock

    stored = kept.rows(path, runs=dict) or {"runs": {}}
    scored = dict(scored)
    machine = scored.pop("machine")
    stored["machine"] = clock.beside(machine, stored.get("machine", {}))
    stored["runs"].setdefault(label, {})[str(seed)] = scored
    write_json(path, stored)


def _config(args, seed):
    return RunConfig(
        preset=args.preset,
        source=cli.plain(args.source),
        steps=args.steps,
        overrides=args.set,
        seed=seed,
    )


def _label(args):
    """Describe the run without the location of its files."""
    source = cli.plain(args.source)
    words = list(source.arguments)
    if source.capture is not None:
        words[0] = source.capture.name
    for name in ("preset", "steps", "seconds"):
        if getattr(args, name) is not None:
            words += [f"--{name}", f"{getattr(args, name)}"]
    if args.set:
        words += ["--set", *args.set]
    return " ".join(words)


def _stem(args):
    return re.sub(r"[^\w.=]+", "-", _label(args)).strip("-")


def _line(scored):
    metrics = scored["metrics"]
    return (
        f"{scored['preset']}, {metrics['heldout.psnr']:.2f} dB, "
        f"{metrics.get('heldout.moving_psnr', float('nan')):.2f} dB moving, "
        f"{metrics['train.seconds']:.0f} s"
    )


if __name__ == "__main__":
    main()
