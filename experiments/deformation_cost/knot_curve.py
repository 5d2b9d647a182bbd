"""What a table of time knots costs in accuracy, by the number of its knots."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.deformation_cost.known_motion import Moving
from gaussians_jax import time_knots
from nerfies_jax.measure import clock
from nerfies_jax.training import losses

INSTANTS = 97  # at which motions are compared; a prime, so hardly one is a knot
DRAWN = 12  # of them, at which pictures are compared


class Point(NamedTuple):
    """One table: its size, its speed, and how far it is from the motion it was made of.

    Errors are shares of the motion's size.
    """

    interpolation: str
    knots: int
    ms: float  # median wall time of an instant
    cpu_ms: float
    bytes: int
    rms: float  # over all Gaussians that move, and all instants
    largest: float
    psnr: float  # dB, of the mean squared error of all pictures


class Curve(NamedTuple):
    """All tables of one motion."""

    name: str
    gaussians: int
    moving: int
    size: float  # the farthest that a mean goes from its middle instant, scene units
    exact_ms: float  # of an instant by the network
    exact_cpu_ms: float
    points: list[Point]


def curve(
    motion: Moving, knots: Sequence[int], static_threshold: float, repeats: int
) -> Curve:
    """Tables of so many knots, linear and cubic, against the motion itself."""
    times = jnp.linspace(0, 1, INSTANTS)
    exact = [jax.device_get(motion.deform(time)) for time in times]
    drawn = np.linspace(1, INSTANTS - 2, DRAWN).round().astype(int)
    truth = [motion.draw(exact[k], times[k]) for k in drawn]
    tables = {
        (way, count): time_knots.bake(motion.deform, count, static_threshold)
        for way, fewest in time_knots.MIN_KNOTS.items()
        for count in knots
        if count >= fewest
    }
    instant = times[INSTANTS // 3]
    calls = {"network": lambda: motion.deform(instant)}
    calls |= {
        f"{way} {count}": lambda way=way, table=table: _at(table, instant, way)
        for (way, count), table in tables.items()
    }
    timing = clock.compare(calls, repeats=repeats)
    paths = np.stack([deform.mean for deform in exact])[:, motion.active]
    ways = np.linalg.norm(paths - paths[INSTANTS // 2], axis=-1)
    size = float(ways.max())
    if not size > 0:
        raise ValueError(
            f"{motion.name}: nothing moves, so there is nothing to compare"
        )
    moved = ways.max(axis=0) > static_threshold
    points = []
    for (way, count), table in tables.items():
        deformed = [_at(table, time, way) for time in times]
        positions = np.stack([deform.mean for deform in deformed])[:, motion.active]
        errors = np.linalg.norm(positions - paths, axis=-1)[:, moved] / size
        pictures = [motion.draw(deformed[k], times[k]) for k in drawn]
        squares = [np.square(a - b) for a, b in zip(pictures, truth, strict=True)]
        points.append(
            Point(
                way,
                count,
                1e3 * timing[f"{way} {count}"].median,
                1e3 * timing[f"{way} {count}"].median_cpu,
                table.bytes,
                float(np.sqrt(np.mean(errors**2))),
                float(errors.max()),
                float(losses.psnr(jnp.asarray(np.mean(squares)))),
            )
        )
    network = timing["network"]
    return Curve(
        motion.name,
        int(motion.active.sum()),
        int(moved.sum()),
        size,
        1e3 * network.median,
        1e3 * network.median_cpu,
        points,
    )


_at = jax.jit(time_knots.at, static_argnums=2)


def text(curve: Curve) -> str:
    """The curve as a table."""
    lines = [
        f"{curve.name}: {curve.gaussians} Gaussians, of which {curve.moving} move by "
        f"up to {curve.size:.3g} scene units; the network takes "
        f"{curve.exact_ms:.2f} ms ({curve.exact_cpu_ms:.2f} CPU) an instant",
        f"{'knots':>5s} {'':7s} {'RMS':>9s} {'largest':>9s} {'PSNR dB':>8s} "
        f"{'ms':>7s} {'CPU ms':>7s} {'speed-up':>8s} {'MB':>6s}",
    ]
    for point in curve.points:
        lines.append(
            f"{point.knots:5d} {point.interpolation:7s} {point.rms:9.2e} "
            f"{point.largest:9.2e} {point.psnr:8.1f} {point.ms:7.2f} "
            f"{point.cpu_ms:7.2f} {curve.exact_cpu_ms / point.cpu_ms:7.1f}x "
            f"{point.bytes / 1e6:6.1f}"
        )
    return "\n".join(lines)
