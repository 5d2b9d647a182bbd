"""What does not move is not evaluated, and stays where it is to the tolerance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core import splats, static_rows
from gaussians_jax.core.splats import Gaussians, Params
from tests import gradients
from tests.gaussians.shared import (
    full,
    jitted,
    put,
    rotations,
    same_bits,
    some_gaussians,
)

TIMES = np.linspace(0, 1, 9)
max_displacement = jitted(static_rows.max_displacement)


def surface_points(gaussians, directions):
    """Points of the one-sigma ellipsoids [gaussians, directions, 3], in float64."""
    turn = rotations(gaussians.quaternion).as_matrix()
    scaled = np.asarray(gaussians.scale, np.float64)[:, None] * directions
    turned = np.einsum("nij,nkj->nki", turn, scaled)
    return turned + np.asarray(gaussians.mean, np.float64)[:, None]


def test_no_point_of_a_gaussian_moves_farther_than_its_reach(dtype, rng):
    before = jax.tree.map(np.asarray, some_gaussians(200, dtype))
    after = jax.tree.map(
        lambda x: x + (rng.uniform(0, 0.2) * rng.normal(size=x.shape)).astype(dtype),
        before,
    )
    after = after._replace(scale=np.abs(after.scale))
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    moved = surface_points(after, directions) - surface_points(before, directions)
    farthest = np.linalg.norm(moved, axis=-1).max(axis=1)
    bound = max_displacement(before, after)
    assert (bound >= farthest * (1 - 1e-5)).all()
    assert np.median(bound / farthest) < 2  # a bound that says something


def test_the_reach_of_a_single_change_is_that_change(dtype):
    changes = [
        ({"mean": [0.3, -0.4, 0.0]}, 0.5),
        ({"mean": [3e-7, -4e-7, 0.0]}, 5e-7),
        ({"scale": [0.0, 0.25, -0.5]}, 0.5),
        ({"quaternion": [-2.0, 0.0, 0.0, 0.0]}, 0.0),  # q becomes -q
        ({"quaternion": [0.0, 2e-6, 0.0, 0.0]}, 4e-6 * 2),  # 4e-6 rad, scale 2
        ({"quaternion": [-1.0, 0.0, 1.0, 0.0]}, 2 * 2),  # half a turn
        ({"opacity": 0.5}, 0.0),
        ({}, 0.0),
    ]
    one = Gaussians([0.0, 0, 0], [1.0, 0, 0, 0], [1.0, 0.5, 2], 0.5)
    before = Gaussians(*(np.array([leaf] * 8, dtype) for leaf in one))
    after = jax.tree.map(np.copy, before)
    for row, (change, _) in enumerate(changes):
        for name, by in change.items():
            getattr(after, name)[row] += np.asarray(by, dtype)
    rounding = {"float32": 1e-6, "float64": 1e-15}[dtype]
    np.testing.assert_allclose(
        max_displacement(before, after),
        [exact for _, exact in changes],
        rtol=rounding,
        atol=1e-12,
    )


def scene(rng, dtype="float32", count=40):
    """Parameters of rows whose speed is theirs, a third of them zero, some inactive."""
    rows = splats.from_points(
        rng.normal(size=(count, 3)), rng.uniform(size=(count, 3)), dtype=dtype
    )
    speed = np.where(np.arange(count) % 3, rng.uniform(1e-4, 0.3, count), 0)
    speed[1] = np.nan
    params = Params({"splats": rows, "speed": put(speed, dtype)}, {})
    return jax.jit(splats.pad_rows, static_argnums=1)(params, count + 8)


def deform(params, time):
    """Every Gaussian sways, turns and breathes at its own speed."""
    gaussians = splats.activate(params.rows["splats"])
    swing = params.rows["speed"] * jnp.sin(5 * time)
    return gaussians._replace(
        mean=gaussians.mean + swing[:, None],
        quaternion=gaussians.quaternion + 0.2 * swing[:, None],
        scale=gaussians.scale * jnp.exp(swing)[:, None],
    )


deformed = jitted(deform)
static_deform = jitted(static_rows.deform, static_argnums=1)


@pytest.mark.parametrize("static_threshold", [0.02, *full(0.0, 0.3)])
def test_what_is_left_out_is_off_by_no_more_than_the_tolerance(static_threshold, rng):
    params = scene(rng)
    parts = static_rows.split(params, deform, TIMES, static_threshold)
    count = len(parts.dynamic.rows["speed"])
    inactive = ~np.asarray(splats.active_mask(params.rows["splats"]))
    moves = np.asarray(parts.row_index.moves)
    assert 0 < count == moves.sum() < len(moves)
    assert not moves[inactive].any()
    assert moves[1]  # its motion is not a number: not taken for static
    for time in np.float32(TIMES):
        assembled, exact = static_deform(parts, deform, time), deformed(params, time)
        for ours, theirs in zip(assembled, exact, strict=True):
            np.testing.assert_array_equal(ours[moves], theirs[moves])
        apart = max_displacement(assembled, exact)[~moves & ~inactive]
        assert (apart <= static_threshold).all()


def test_what_comes_and_goes_is_drawn_while_it_is_there(rng):
    """Gone at the middle instant, at which rows are compared: moving, and at rest."""
    params = scene(rng, count=3)
    params.rows["speed"] = put(np.r_[0.3, 0, 0, np.zeros(8)])
    width = put(np.r_[0.04, 0.15, 1e9, np.ones(8)])

    def fading(params, time):
        now = deform(params, time)
        share = jnp.exp(-(((time - 0.1) / params.rows["width"]) ** 2))
        return now._replace(opacity=now.opacity * share)

    params.rows["width"] = width
    parts = static_rows.split(params, fading, TIMES, 0.01)
    assert parts.row_index.moves[:4].tolist() == [True, True, False, False]
    early = np.float32(TIMES[1])
    there = jax.jit(static_rows.deform, static_argnums=1)(parts, fading, early)
    np.testing.assert_allclose(there.opacity, fading(params, early).opacity, rtol=1e-6)
    # To be hidden, a row must move: one at rest stays, however short it is there.
    parts = static_rows.split(params, fading, TIMES, 0.01, fading=False)
    assert parts.row_index.moves[:4].tolist() == [True, False, False, False]


def test_where_nothing_moves_nothing_is_evaluated(rng):
    params = scene(rng)
    params.rows["speed"] = put(np.zeros_like(params.rows["speed"]))
    parts = static_rows.split(params, deform, TIMES, 0.0)

    def refuse(params, time):
        raise AssertionError("evaluated")

    assembled = static_deform(parts, refuse, np.float32(0.3))
    same_bits(assembled, jitted(splats.activate)(params.rows["splats"]))


def test_moving_rows_keep_their_gradients(rng, float64):
    params = scene(rng, float64)
    params.rows["speed"] = put(np.nan_to_num(params.rows["speed"]))
    parts = static_rows.split(params, deform, TIMES, 0.02)

    def loss(speed, time):
        rows = parts.dynamic.rows | {"speed": speed}
        now = parts._replace(dynamic=parts.dynamic._replace(rows=rows))
        deformed = static_rows.deform(now, deform, time)
        return sum(jnp.sum(jnp.sin(3 * leaf)) for leaf in deformed)

    speed = parts.dynamic.rows["speed"]
    assert gradients.directional_error(loss, speed, put(0.4)) < 1e-7
