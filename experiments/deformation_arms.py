"""The ways to put Gaussians where they are at a time, each as programs to be timed."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gaussians_jax import splats, still_rows, time_knots
from gaussians_jax.effects import deformation, mlp_motion, motion_basis
from gaussians_jax.effects.effect import Effect
from gaussians_jax.effects.mlp_motion import SMALL_MOTION, MotionSpec
from gaussians_jax.effects.motion_basis import SMALL_BASIS_MOTION, BasisMotionSpec
from gaussians_jax.splats import Params

KNOTS = 16  # of the tables that are timed; their number hardly changes the time


class Arm(NamedTuple):
    """One way to pose Gaussians, forward and, where it is trained, backward."""

    name: str
    pose: Callable  # (*inputs) -> Gaussians
    inputs: tuple[Any, ...]
    gradient: Callable | None = None  # (*inputs) -> slopes
    # The same, every Gaussian in one block: the compiler counts a loop's body once.
    counted_pose: Callable | None = None
    counted_gradient: Callable | None = None


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
    Network("motion basis", BasisMotionSpec(), motion_basis.effect, True),
    Network("motion basis, small", SMALL_BASIS_MOTION, motion_basis.effect, False),
)


def arms(count: int, still: float) -> list[Arm]:
    """All of them for `count` Gaussians, of which a share `still` need not be posed."""
    time = jnp.asarray(0.37, jnp.float32)
    made = []
    for network in NETWORKS:
        made += _network_arms(network, count, still, time)
    made += _table_arms(count, time)
    return made


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
        count = len(params.rows["splats"].mean)
        rows[effect.name] = effect.init_rows(rows_key, count)
    if effect.init_nets is not None:
        nets[effect.name] = effect.init_nets(nets_key)
    return Params(rows, nets)


def _network_arms(network, count, still, time):
    """Whole, with what `prepare` returns kept, and without what stands still."""

    def effects(block=None):
        spec = network.spec
        spec = spec if block is None else dataclasses.replace(spec, block=block)
        return (network.effect(spec, 1, 2),)

    blocked, whole = effects(), effects(count)
    params = with_effect(gaussians(count), blocked[0])

    def posed(effects):
        def pose(params, time):
            ready = deformation.prepare(effects, params)
            return deformation.pose(effects, params, ready, time)

        return pose

    def sloped(pose):
        def loss(params, time):
            posed = pose(params, time)
            return sum(jnp.sum(jnp.sin(leaf)) for leaf in posed)

        return jax.grad(loss)

    yield Arm(
        network.name,
        posed(blocked),
        (params, time),
        sloped(posed(blocked)),
        posed(whole),
        sloped(posed(whole)),
    )
    ready = jax.jit(lambda params: deformation.prepare(blocked, params))(params)
    kept = jax.tree.leaves(ready)
    if kept:
        yield Arm(
            f"{network.name}, prepared kept",
            lambda params, ready, time: deformation.pose(blocked, params, ready, time),
            (params, ready, time),
            counted_pose=lambda params, ready, time: deformation.pose(
                whole, params, ready, time
            ),
        )
    if network.paper:
        yield _still_arm(network, blocked, whole, params, still, time)


def _still_arm(network, blocked, whole, params, still, time):
    count = len(params.rows["splats"].mean)
    moves = np.random.default_rng(1).permutation(count) >= round(still * count)
    rows = jnp.asarray(np.flatnonzero(moves), jnp.int32)
    parts = still_rows.Split(
        splats.activate(params.rows["splats"]),
        still_rows.where(moves),
        splats.take_rows(params, rows),
    )
    ready = jax.jit(lambda params: deformation.prepare(blocked, params))(parts.moving)

    def posed(effects):
        def pose(parts, ready, time):
            return still_rows.pose(
                parts,
                lambda rows, time: deformation.pose(effects, rows, ready, time),
                time,
            )

        return pose

    kept = ", prepared kept" if jax.tree.leaves(ready) else ""
    return Arm(
        f"{network.name}{kept}, {100 * still:g} % still",
        posed(blocked),
        (parts, ready, time),
        counted_pose=posed(whole),
    )


def _table_arms(count, time):
    """From a table, every Gaussian moving: the time does not depend on the network."""
    still = splats.activate(gaussians(count).rows["splats"])
    table = time_knots.bake(lambda t: still._replace(mean=still.mean + t), KNOTS)
    for interpolation in time_knots.FEWEST:

        def pose(table, time, interpolation=interpolation):
            return time_knots.at(table, time, interpolation)

        name = f"{KNOTS} time knots, {interpolation}"
        yield Arm(name, pose, (table, time), counted_pose=pose)
