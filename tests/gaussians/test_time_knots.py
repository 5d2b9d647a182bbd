"""Time knots: exact at the knots, of their order between, safe for any rotation."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
import scipy.spatial.transform

from gaussians_jax.core import static_rows, time_knots
from gaussians_jax.core.splats import LOG_SCALE_RANGE, Gaussians
from tests import gradients
from tests.gaussians.shared import finite, full, jitted, put, rotations, same_bits

COUNT = 12
at = jitted(time_knots.at, static_argnums=2)
max_displacement = jitted(static_rows.max_displacement)


@functools.partial(jax.jit, static_argnums=1)
def moving(time, dtype="float32"):
    """Half of the Gaussians move, smoothly; the quaternions change sign at will."""
    rng = np.random.default_rng(3)
    number = np.arange(COUNT)
    moves = jnp.asarray(number % 2, dtype)[:, None]
    center, swing = (jnp.asarray(rng.normal(size=(COUNT, 3)), dtype) for _ in "ab")
    phase = jnp.asarray(rng.uniform(0, 6, (COUNT, 1)), dtype)
    angle = moves * jnp.sin(4 * time + phase) * 1.2
    turn = jnp.concatenate(
        [
            jnp.cos(angle),
            jnp.sin(angle) * swing / jnp.linalg.norm(swing, axis=1)[:, None],
        ],
        axis=1,
    )
    sign = jnp.where(jnp.sin(40 * time + phase) > 0, 1, -1).astype(dtype)
    return Gaussians(
        mean=center + moves * swing * jnp.sin(5 * time + phase),
        quaternion=turn * sign * 1.7,
        scale=0.2 * jnp.exp(moves * jnp.cos(3 * time) * swing),
        opacity=jnp.asarray(rng.uniform(0.1, 1, COUNT), dtype),
    )


def at_all(knots, times, interpolation="linear"):
    """The Gaussians at all times, each leaf [times, gaussians, ...]."""
    times = np.asarray(times, knots.times.dtype)
    run = jax.vmap(lambda time: time_knots.at(knots, time, interpolation))
    return jitted(run)(times)


@functools.cache
def exact_at_all(dtype):
    return jitted(jax.vmap(lambda time: moving(time, dtype)))


def angles(ours, exact):
    ours, exact = (rotations(x.quaternion.reshape(-1, 4)) for x in (ours, exact))
    return (ours.inv() * exact).magnitude()


def differences(ours, exact):
    """Largest error of the means, of the logarithms of the scales, and of angles."""
    return np.array(
        [
            np.abs(ours.mean - exact.mean).max(),
            np.abs(np.log(ours.scale) - np.log(exact.scale)).max(),
            angles(ours, exact).max(),
        ]
    )


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("count", [7, *full(4, 50)])
def test_the_knots_themselves_are_met(interpolation, count, dtype):
    knots = time_knots.bake(lambda t: moving(t, dtype), count, dtype=dtype)
    assert knots.track.mean.shape == (count, COUNT // 2, 3)
    for time in np.asarray(knots.times):
        exact = moving(time, dtype)
        interpolated = at(knots, time, interpolation)
        rounding = {"float32": 1e-6, "float64": 1e-14}[dtype]
        assert (differences(interpolated, exact) < [1e-30, rounding, rounding]).all()
        np.testing.assert_array_equal(interpolated.opacity, exact.opacity)
        assert interpolated.mean.dtype == dtype


@pytest.mark.full
@pytest.mark.parametrize(("interpolation", "order"), [("cubic", 3), ("linear", 2)])
def test_the_error_falls_with_the_order_of_the_interpolation(
    interpolation, order, float64
):
    times, errors = np.linspace(0, 1, 301), []
    for count in (17, 33, 65):
        knots = time_knots.bake(lambda t: moving(t, "float64"), count, dtype=float64)
        interpolated = at_all(knots, times, interpolation)
        errors.append(differences(interpolated, exact_at_all("float64")(times)))
    observed = np.log2(np.divide(errors[:-1], errors[1:]))
    # Doubled knots, over the whole of [0, 1]: the end intervals are of that order too.
    assert (observed > order - 0.35).all(), observed


def catmull_rom(times, values, at):
    """Cubic Hermite with central slopes, and a parabola's at the ends."""
    grads = np.gradient(values, times, axis=0, edge_order=2)
    return scipy.interpolate.CubicHermiteSpline(times, values, grads)(at)


@pytest.mark.parametrize("count", [5, *full(4, 9)])
def test_cubic_is_a_hermite_spline_with_central_slopes(count, dtype):
    knots = time_knots.bake(lambda t: moving(t, dtype), count, dtype=dtype)
    times, even = np.linspace(0, 1, 57), np.linspace(0, 1, count)
    rows = np.flatnonzero(knots.row_index.moves)
    interpolated = at_all(knots, times, "cubic")
    rounding = {"float32": 1e-5, "float64": 1e-13}[dtype]
    for leaf, ours in zip(
        knots.track, (interpolated.mean, np.log(interpolated.scale)), strict=False
    ):
        exact = catmull_rom(even, np.asarray(leaf, np.float64), times)
        np.testing.assert_allclose(ours[:, rows], exact, atol=rounding)
    place = np.asarray(knots.track.mean, np.float64)[:, 0, 0]
    interpolated = at_all(knots, times).mean[
        :, rows[0], 0
    ]  # linear, which is the default
    np.testing.assert_allclose(
        interpolated, np.interp(times, even, place), atol=rounding
    )


def constant(quaternion, dtype):
    one = Gaussians(np.zeros((1, 3)), [quaternion], np.ones((1, 3)), np.ones(1))
    return put(one, dtype)


@pytest.mark.parametrize("interpolation", ["cubic", *full("linear")])
@pytest.mark.parametrize(
    "ends",
    [
        ([1.0, 0, 0, 0], [-1e-7, 0, 0, 1.0]),  # half a turn apart
        ([0.0, 0, 0, 0], [1.0, 0, 0, 0]),  # no rotation at all: the identity
        *full(
            (([1.0, 0, 0, 0], [-1.0, 0, 0, 0]),),  # the same rotation
            (([1.0, 0, 0, 0], [0, 1.0, 0, 0]),),
            (([1e-12, 0, 0, 0], [0, 0, 1e10, 0]),),
        ),
    ],
)
def test_opposite_quaternions_have_a_rotation_between(ends, interpolation, dtype):
    first, second = (constant(quaternion, dtype) for quaternion in ends)

    @jax.jit
    def deform(time):  # to and fro at every knot, which is worst for a cubic
        odd = jnp.round(5 * time) % 2 == 1
        moved = jax.tree.map(lambda a, b: jnp.where(odd, a, b), first, second)
        return moved._replace(mean=jnp.ones((1, 3), dtype) * time)

    knots = time_knots.bake(deform, 6, dtype=dtype)

    def turn(time):
        quaternion = time_knots.at(knots, time, interpolation).quaternion
        return quaternion, quaternion

    run = jitted(jax.vmap(jax.jacfwd(turn, has_aux=True)))
    slope, quaternions = run(np.linspace(0, 1, 41, dtype=dtype))
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=-1), 1, rtol=1e-6)
    assert finite(slope)


def test_a_time_outside_is_held_at_the_nearer_end(dtype):
    knots = time_knots.bake(lambda t: moving(t, dtype), 7, dtype=dtype)
    times = np.asarray([-0.3, -1e30, 0, 1.2, 1e30, 1], dtype)
    for interpolation in time_knots.MIN_KNOTS:
        held = [at(knots, time, interpolation) for time in times]
        for beyond, end in ((0, 2), (1, 2), (3, 5), (4, 5)):
            same_bits(held[beyond], held[end])


@pytest.mark.parametrize("size", [0.0, -0.5, *full(1e-30, 1e-3)])
def test_scales_that_shrink_through_zero_stay_positive_and_finite(size, dtype):
    @jax.jit
    def deform(time):
        static = constant([1.0, 0, 0, 0], dtype)
        return static._replace(scale=jnp.ones((1, 3), dtype) + (size - 1) * time)

    knots = time_knots.bake(deform, 4, dtype=dtype)
    for interpolation in time_knots.MIN_KNOTS:
        scale = at_all(knots, [0.0, 0.7, 0.9, 1.0], interpolation).scale
        assert (scale > 0).all()
        assert np.isfinite(scale).all()
        smallest = max(abs(size), np.exp(LOG_SCALE_RANGE[0]))
        # 1 - 0.999 leaves float32 four digits.
        np.testing.assert_allclose(scale[-1], smallest, rtol=1e-4)


@pytest.mark.parametrize("static_threshold", [0.5, *full(0.0, 1e9)])
def test_static_rows_are_stored_once_and_stay_within_the_tolerance(static_threshold):
    knots = time_knots.bake(moving, 9, static_threshold)
    moves = np.asarray(knots.row_index.moves)
    assert not moves[::2].any()
    assert knots.bytes == 40 * 9 * moves.sum()
    for time in np.asarray(knots.times):
        distance = max_displacement(at(knots, time), moving(time))
        assert distance[~moves].max() <= static_threshold
        np.testing.assert_allclose(distance[moves], 0, atol=2e-6)
    assert {0.0: moves.sum() == COUNT // 2, 1e9: not moves.any()}.get(
        static_threshold, True
    )


@pytest.mark.full
def test_gradients_in_time_and_in_the_knots(float64):
    knots = time_knots.bake(lambda t: moving(t, "float64"), 7, dtype=float64)

    def loss(track, times, interpolation):
        moved = knots._replace(track=track)
        run = jax.vmap(lambda time: time_knots.at(moved, time, interpolation))
        return sum(jnp.sum(jnp.sin(3 * leaf)) for leaf in run(times))

    times = put([0.05, 0.45, 0.93])  # in the first, an inner and the last interval
    for interpolation in time_knots.MIN_KNOTS:
        of = functools.partial(loss, interpolation=interpolation)
        assert gradients.directional_error(of, knots.track, times) < 1e-7
