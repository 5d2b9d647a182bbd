"""Time knots: exact at the knots, of their order between, safe for any rotation."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
import scipy.spatial.transform

from gaussians_jax import static_rows, time_knots
from gaussians_jax.splats import LOG_SCALE_RANGE, Gaussians
from tests import gradients

COUNT = 12
at = jax.jit(time_knots.at, static_argnums=2)


@functools.partial(jax.jit, static_argnums=1)
def moving(time, dtype="float32"):
    """Half of the Gaussians move, smoothly; the quaternions change sign at will."""
    rng = np.random.default_rng(3)
    number = np.arange(COUNT)
    moves = jnp.asarray(number % 2, dtype)[:, None]
    centre, swing = (jnp.asarray(rng.normal(size=(COUNT, 3)), dtype) for _ in "ab")
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
        mean=centre + moves * swing * jnp.sin(5 * time + phase),
        quaternion=turn * sign * 1.7,
        scale=0.2 * jnp.exp(moves * jnp.cos(3 * time) * swing),
        opacity=jnp.asarray(rng.uniform(0.1, 1, COUNT), dtype),
    )


def rotations(gaussians):
    wxyz = np.asarray(gaussians.quaternion, np.float64)
    return scipy.spatial.transform.Rotation.from_quat(wxyz[:, [1, 2, 3, 0]])


def differences(found, exact):
    """Largest error of the means, of the logarithms of the scales, and of angles."""
    angle = (rotations(found).inv() * rotations(exact)).magnitude()
    return np.array(
        [
            np.abs(found.mean - exact.mean).max(),
            np.abs(np.log(found.scale) - np.log(exact.scale)).max(),
            angle.max(),
        ]
    )


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("count", [4, 7, 50])
def test_the_knots_themselves_are_met(interpolation, count, dtype):
    knots = time_knots.bake(lambda t: moving(t, dtype), count, dtype=dtype)
    assert knots.track.mean.shape == (count, COUNT // 2, 3)
    for time in knots.times:
        exact = moving(time, dtype)
        found = at(knots, time, interpolation)
        rounding = {"float32": 1e-6, "float64": 1e-14}[dtype]
        assert (differences(found, exact) < [1e-30, rounding, rounding]).all()
        np.testing.assert_array_equal(found.opacity, exact.opacity)
        assert found.mean.dtype == dtype


@pytest.mark.full
@pytest.mark.parametrize(("interpolation", "order"), [("linear", 2), ("cubic", 3)])
def test_the_error_falls_with_the_order_of_the_interpolation(
    interpolation, order, float64
):
    times = np.linspace(0, 1, 301)
    errors = []
    for count in (17, 33, 65):
        knots = time_knots.bake(lambda t: moving(t, "float64"), count, dtype=float64)
        worst = [
            differences(at(knots, jnp.asarray(t), interpolation), moving(t, "float64"))
            for t in times
        ]
        errors.append(np.max(worst, axis=0))
    observed = np.log2(np.divide(errors[:-1], errors[1:]))
    # Doubled knots, over the whole of [0, 1]: the end intervals are of that order too.
    assert (observed > order - 0.35).all(), observed


def catmull_rom(times, values, at):
    """Cubic Hermite with central slopes, and a parabola's at the ends."""
    grads = np.gradient(values, times, axis=0, edge_order=2)
    return scipy.interpolate.CubicHermiteSpline(times, values, grads)(at)


@pytest.mark.parametrize("count", [4, 5, 9])
def test_cubic_is_a_hermite_spline_with_central_slopes(count, dtype):
    knots = time_knots.bake(lambda t: moving(t, dtype), count, dtype=dtype)
    times = np.linspace(0, 1, 57)
    even = np.linspace(0, 1, count)
    means, logs = (np.asarray(x, np.float64) for x in knots.track[:2])
    rows = np.flatnonzero(knots.index.moves)
    for time, mean, log in zip(
        times,
        catmull_rom(even, means, times),
        catmull_rom(even, logs, times),
        strict=True,
    ):
        found = at(knots, jnp.asarray(time, dtype), "cubic")
        rounding = {"float32": 1e-5, "float64": 1e-13}[dtype]
        np.testing.assert_allclose(found.mean[rows], mean, atol=rounding)
        np.testing.assert_allclose(np.log(found.scale[rows]), log, atol=rounding)


@pytest.mark.full
def test_linear_rotations_follow_the_great_circle(dtype):
    knots = time_knots.bake(lambda t: moving(t, dtype), 40, dtype=dtype)
    rows = np.flatnonzero(knots.index.moves)
    times = np.asarray(knots.times, np.float64)
    left, right = (
        rotations(moving(jnp.asarray(times[k], dtype), dtype)) for k in (9, 10)
    )
    for share in (0.25, 0.5, 0.8):
        time = jnp.asarray(times[9] + share * (times[10] - times[9]), dtype)
        exact = left * (left.inv() * right) ** share
        found = rotations(at(knots, time))
        angle = (found.inv() * exact).magnitude()[rows]
        # nlerp leaves slerp by 0.02 angle³; here knots are at most 0.13 rad apart.
        assert angle.max() < 1e-4


def constant(quaternion, dtype):
    return Gaussians(
        jnp.zeros((1, 3), dtype),
        jnp.asarray([quaternion], dtype),
        jnp.ones((1, 3), dtype),
        jnp.ones(1, dtype),
    )


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize(
    "ends",
    [
        ([1.0, 0, 0, 0], [-1.0, 0, 0, 0]),  # the same rotation
        ([1.0, 0, 0, 0], [0, 1.0, 0, 0]),  # half a turn apart
        ([1.0, 0, 0, 0], [-1e-7, 0, 0, 1.0]),
        ([0.0, 0, 0, 0], [1.0, 0, 0, 0]),  # no rotation at all: the identity
        ([1e-12, 0, 0, 0], [0, 0, 1e10, 0]),
    ],
)
def test_opposite_quaternions_have_a_rotation_between(ends, interpolation, dtype):
    first, second = (constant(quaternion, dtype) for quaternion in ends)

    def deform(time):  # to and fro at every knot, which is worst for a cubic
        odd = jnp.round(5 * time) % 2 == 1
        moved = jax.tree.map(lambda a, b: jnp.where(odd, a, b), first, second)
        return moved._replace(mean=jnp.ones((1, 3), dtype) * time)

    knots = time_knots.bake(deform, 6, dtype=dtype)
    draw = jax.jit(lambda time: at(knots, time, interpolation))
    grad = jax.jit(jax.jacfwd(lambda time: draw(time).quaternion))
    for time in np.linspace(0, 1, 41):
        time = jnp.asarray(time, dtype)
        length = np.linalg.norm(draw(time).quaternion)
        np.testing.assert_allclose(length, 1, rtol=1e-6)
        assert np.isfinite(grad(time)).all()


def test_a_time_outside_is_held_at_the_nearer_end(dtype):
    knots = time_knots.bake(lambda t: moving(t, dtype), 6, dtype=dtype)
    for interpolation in time_knots.MIN_KNOTS:
        for beyond, end in ((-0.3, 0), (-1e30, 0), (1.2, 1), (1e30, 1)):
            found, held = (
                at(knots, jnp.asarray(time, dtype), interpolation)
                for time in (beyond, end)
            )
            jax.tree.map(np.testing.assert_array_equal, found, held)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-3, -0.5])
def test_scales_that_shrink_through_zero_stay_positive_and_finite(size, dtype):
    def deform(time):
        static = constant([1.0, 0, 0, 0], dtype)
        return static._replace(scale=jnp.ones((1, 3), dtype) + (size - 1) * time)

    knots = time_knots.bake(deform, 4, dtype=dtype)
    for interpolation in time_knots.MIN_KNOTS:
        for time in (0.0, 0.7, 0.9, 1.0):
            scale = at(knots, jnp.asarray(time, dtype), interpolation).scale
            assert (scale > 0).all()
            assert np.isfinite(scale).all()
        smallest = max(abs(size), np.exp(LOG_SCALE_RANGE[0]))
        # 1 - 0.999 leaves float32 four digits.
        np.testing.assert_allclose(scale, smallest, rtol=1e-4)


@pytest.mark.parametrize("static_threshold", [0.0, 0.5, 1e9])
def test_static_rows_are_stored_once_and_stay_within_the_tolerance(static_threshold):
    knots = time_knots.bake(moving, 9, static_threshold)
    moves = np.asarray(knots.index.moves)
    assert not moves[::2].any()
    assert knots.bytes == time_knots.BYTES * 9 * moves.sum()
    for time in knots.times:
        found = at(knots, time)
        distance = np.asarray(static_rows.max_displacement(found, moving(time)))
        assert distance[~moves].max() <= static_threshold
        np.testing.assert_allclose(distance[moves], 0, atol=2e-6)
    assert {0.0: moves.sum() == COUNT // 2, 1e9: not moves.any()}.get(
        static_threshold, True
    )


def test_gradients_in_time_and_in_the_knots(float64):
    knots = time_knots.bake(lambda t: moving(t, "float64"), 6, dtype=float64)

    def loss(track, time, interpolation):
        deformed = at(knots._replace(track=track), time, interpolation)
        return sum(jnp.sum(jnp.sin(3 * leaf)) for leaf in deformed)

    for interpolation in time_knots.MIN_KNOTS:
        for time in (0.05, 0.5, 0.93):  # the first, an inner and the last interval
            of = functools.partial(loss, interpolation=interpolation)
            inputs = knots.track, jnp.asarray(time)
            assert gradients.directional_error(of, *inputs) < 1e-7


@pytest.mark.full
def test_cubic_has_a_continuous_velocity(float64):
    knots = time_knots.bake(lambda t: moving(t, "float64"), 8, dtype=float64)
    for interpolation, smooth in (("linear", False), ("cubic", True)):
        velocity = jax.jit(
            jax.jacfwd(lambda time, by=interpolation: at(knots, time, by).mean)
        )
        for knot in knots.times[1:-1]:
            jump = velocity(knot + 1e-9) - velocity(knot - 1e-9)
            assert (np.abs(jump).max() < 1e-5) == smooth
