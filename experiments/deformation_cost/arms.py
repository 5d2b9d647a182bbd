"""The ways to put Gaussians where they are at a time, each as programs to be timed."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gaussians_jax import splats, static_rows, time_knots
from gaussians_jax.effects import deformation, kan_motion, mlp_motion, motion_basis
from gaussians_jax.effects.kan_motion import SMALL_KAN_MOTION, KanMotionSpec
from gaussians_jax.effects.mlp_motion import SMALL_MOTION, MotionSpec
from gaussians_jax.effects.motion_basis import SMALL_BASIS_MOTION, BasisMotionSpec
from gaussians_jax.splats import Params
from nerfies_jax.training.effects import Effect

UNROLLED = 4  # kernels that a KAN's loop sums in one turn
FRAMES = 100  # of the capture whose motion it would be
KNOTS = 16  # of the tables that are timed; their number hardly changes the time


class Way(NamedTuple):
    """A program that deforms Gaussians, and its derivative where it is trained."""

    deform: Callable  # (*inputs) -> Gaussians
    inputs: tuple[Any, ...]
    gradient: Callable | None = None  # (*inputs) -> slopes


class Contender(NamedTuple):
    """One way to deform Gaussians, as it is used and as the compiler can count it."""

    name: str
    used: Way
    # Summed with these weights they have the operations of `used`. The compiler counts
    # the body of a loop once: here every Gaussian is in one block, and a loop over
    # kernels has one turn.
    counted: tuple[tuple[float, Way], ...]


class Network(NamedTuple):
    """A motion network by its spec."""

    name: str
    spec: Any  # with a field `block`
    effect: Callable[[Any, int, int], Effect]  # (spec, steps, frames)
    paper: bool  # of the size in its paper


NETWORKS = (
    Network("MLP 8x256", MotionSpec(smoothing=None), mlp_motion.effect, True),
    Network(
        "MLP 4x64",
        dataclasses.replace(SMALL_MOTION, smoothing=None),
        mlp_motion.effect,
        False,
    ),
    Network("RBF-KAN", KanMotionSpec(), kan_motion.effect, True),
    Network("RBF-KAN, small", SMALL_KAN_MOTION, kan_motion.effect, False),
    Network("motion basis", BasisMotionSpec(), motion_basis.effect, True),
    Network("motion basis, small", SMALL_BASIS_MOTION, motion_basis.effect, False),
)


def arms(count: int, still: float) -> list[Contender]:
    """All of them for `count` Gaussians; a share `still` need not be deformed."""
    contenders = []
    for network in NETWORKS:
        used = _ways(network, network.spec, count, still)
        counted = [
            (weight, _ways(network, spec, count, still))
            for weight, spec in in_one_turn(network.spec, count)
        ]
        for name, way in used.items():
            parts = tuple((weight, ways[name]) for weight, ways in counted)
            contenders.append(Contender(f"{network.name}{name}", way, parts))
    return contenders + _table_arms(count)


def in_one_turn(spec: Any, count: int) -> list[tuple[float, Any]]:
    """Specs without loops whose operations, weighted, sum to those of `spec`."""
    whole = dataclasses.replace(spec, block=count)
    if getattr(spec, "kernels", 0) <= UNROLLED:
        return [(1.0, whole)]
    # Operations are a + b kernels: a line through two numbers that are one turn.
    few, more = UNROLLED // 2, UNROLLED
    beyond = (spec.kernels - more) / (more - few)
    return [
        (1 + beyond, dataclasses.replace(whole, kernels=more)),
        (-beyond, dataclasses.replace(whole, kernels=few)),
    ]


def gaussians(count: int, seed: int = 0) -> Params:
    """Round Gaussians spread evenly over a cube of side 2, no networks yet."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    rows = splats.from_points(points, (points + 1) / 2, degree=0, opacity=0.8)
    return Params({"splats": rows}, {})


def with_effect(params: Params, effect: Effect) -> Params:
    """The parameters with the first ones of an effect."""
    rows_key, nets_key = jax.random.split(jax.random.key(0))
    rows, nets = dict(params.rows), dict(params.nets)
    if effect.init_rows is not None:
        rows[effect.name] = effect.init_rows(rows_key, params.rows["splats"])
    if effect.init is not None:
        nets[effect.name] = effect.init(nets_key)
    return Params(rows, nets)


def _ways(network, spec, count, still):
    """Whole, with what `prepare` returns kept, and without what stands still."""
    time = jnp.asarray(0.37, jnp.float32)
    effects = (network.effect(spec, 1, FRAMES),)
    params = with_effect(gaussians(count), effects[0])

    def deform(params, time):
        ready = deformation.prepare(effects, params)
        return deformation.deform(effects, params, ready, time)

    def loss(params, time):
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in deform(params, time))

    def pose_prepared(params, ready, time):
        return deformation.deform(effects, params, ready, time)

    def pose_moving(parts, ready, time):
        def rows(params, time):
            return deformation.deform(effects, params, ready, time)

        return static_rows.deform(parts, rows, time)

    prepare = jax.jit(lambda params: deformation.prepare(effects, params))
    ready = prepare(params)
    ways = {"": Way(deform, (params, time), jax.grad(loss))}
    kept = ", prepared kept" if jax.tree.leaves(ready) else ""
    if kept:
        ways[kept] = Way(pose_prepared, (params, ready, time))
    if network.paper:
        parts = _split(params, still)
        name = f"{kept}, {100 * still:g} % still"
        ways[name] = Way(pose_moving, (parts, prepare(parts.dynamic), time))
    return ways


def _split(params, still):
    """As `static_rows.split` would leave it, of any rows."""
    count = len(params.rows["splats"].mean)
    moves = np.random.default_rng(1).permutation(count) >= round(still * count)
    rows = jnp.asarray(np.flatnonzero(moves), jnp.int32)
    return static_rows.StaticDynamicSplit(
        splats.activate(params.rows["splats"]),
        static_rows.row_index(moves),
        splats.take_rows(params, rows),
    )


def _table_arms(count):
    """From a table, every Gaussian moving: the time does not depend on the network."""
    still = splats.activate(gaussians(count).rows["splats"])
    table = time_knots.bake(lambda t: still._replace(mean=still.mean + t), KNOTS)
    contenders = []
    for interpolation in time_knots.MIN_KNOTS:

        def deform(table, time, interpolation=interpolation):
            return time_knots.at(table, time, interpolation)

        way = Way(deform, (table, jnp.asarray(0.37, jnp.float32)))
        name = f"{KNOTS} time knots, {interpolation}"
        contenders.append(Contender(name, way, ((1.0, way),)))
    return contenders
