"""Growth of time and memory with Gaussians, pixels, frames, motion and rays.

    nerfies study growth
    nerfies study growth --axes Gaussians rays --points 2
    nerfies study results growth --measured runs/growth/growth.json

Which size of a scene limits it first? Each axis lets one size grow and times compiled
training steps of one view or batch of rays, on one core, in medians of processor time.
Splats start as random points whose size falls with their number. Memory is that of the
inputs and temporary arrays of the step. Flops and bytes are the compiler's, which
counts the body of every loop once, so for the loops of the rasterizer they are no
measure of work. *Pairs* of Gaussians and tiles are.
"""

import concurrent.futures
import dataclasses
import json
import multiprocessing
import os
import pathlib

from experiments import cli, records
from experiments.growth.axes import AXES
from nerfies_jax.runs import platform
from nerfies_jax.runtime import children, console

STORED = "growth.json"
SPEED = pathlib.Path(__file__).resolve().parents[1] / "measured" / "speed.json"


@dataclasses.dataclass(frozen=True)
class Growth:
    """Measure how time and memory of a training step grow."""

    axes: tuple[str, ...] = tuple(AXES)
    """Axes to measure."""
    points: int | None = None
    """Sizes of each axis, from the smallest on (default: all)."""
    out: pathlib.Path = pathlib.Path("runs/growth")
    """Folder of the results. Those of other axes and sizes stay."""

    def __post_init__(self):
        unknown = [name for name in self.axes if name not in AXES]
        if unknown:
            raise ValueError(f"--axes {unknown[0]!r}: choose from {', '.join(AXES)}")
        if self.points is not None and self.points < 1:
            raise ValueError(f"--points {self.points} must be at least 1")


@cli.command(Growth)
def main(args):
    """Measure and store. Wrong input ends with exit code 2."""
    with cli.user_errors():
        args.out.mkdir(parents=True, exist_ok=True)
        path = args.out / STORED
    results = records.rows(path)
    job = json.loads(SPEED.read_text())["job"]
    results |= {"job_seconds": job["seconds"], "train_seconds": job["train.seconds"]}
    for axis in args.axes:
        # A process for each axis, so that the memory of the last one is free.
        with concurrent.futures.ProcessPoolExecutor(
            1,
            multiprocessing.get_context("spawn"),
            children.end_with_parent,
            (os.getpid(),),
        ) as pool:
            for size in AXES[axis].sizes[: args.points]:
                machine, record = pool.submit(_point, axis, size).result()
                results.setdefault("axes", {}).setdefault(axis, {})[str(size)] = record
                records.write(path, results, machine)
                console.say(f"{axis} {size:,}: {record['cpu_seconds']:.3g} s a step")
    console.say(f"stored in {path}")
    return results


def _point(axis, size):
    platform.start_jax("cpu", "one")  # of the first call in this process
    from experiments.growth import measure
    from nerfies_jax.metrics import clock

    return clock.machine(), measure.point(axis, size)


if __name__ == "__main__":
    main()
