"""Rotations and screws at their hard points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform

from experiments.hard_cases import case as hard_case
from experiments.hard_cases import quaternions, rotations
from nerfies_jax.geometry import lie, quaternion
from nerfies_jax.geometry.stumpff import SERIES_BELOW, stumpff
from tests.experiments.hard_cases import checks

CASES = rotations.CASES + quaternions.CASES
Rotation = scipy.spatial.transform.Rotation
TIGHT = {"float32": 2e-6, "float64": 4e-15}
LINEAR, POINT = rotations.LINEAR, rotations.POINT
WXYZ = np.array([0.5, -0.5, 0.1, 0.7])

pytestmark = pytest.mark.hard_cases
test_held = checks.by_case(CASES)


@pytest.mark.full
def test_a_float32_point_moved_by_a_bfloat16_screw_stays_float32():
    screw = [x.astype(jnp.bfloat16) for x in (0.3 * rotations.AXIS, LINEAR)]
    point = POINT.astype(np.float32)
    transform = jax.jit(lie.transform_point)
    moved = transform(*screw, point)
    wide = transform(*(x.astype(np.float32) for x in screw), point)
    assert moved.dtype == jnp.float32
    assert np.array_equal(moved, wide)


def _every_degree(x):
    return jnp.stack([stumpff(degree, x[0]) for degree in range(6)])


def test_stumpff_functions_are_continuous_across_their_switch(dtype):
    """Neighboring numbers, one by the series and one by the closed form."""
    above = np.asarray(SERIES_BELOW, dtype)
    below = np.nextafter(above, np.asarray(0, dtype))
    ends = np.array([[below], [above]])
    for order, values in enumerate(hard_case.evaluate(_every_degree, ends, dtype, 3)):
        # c_k(9) are 0.05 to 1; sin and cos of √9 carry an ulp of one
        off = np.max(abs(values[1] - values[0]))
        assert off < 4 * np.finfo(dtype).eps / (1 + order)


def test_quaternion_logarithm_is_continuous_across_its_switch(dtype):
    """Scalar and vector just on either side of tan²(θ/2) = 0.04."""
    half = np.arctan(quaternion.SERIES_BELOW**0.5)
    step = 2 * np.finfo(dtype).eps
    ends = np.array([half * (1 - step), half * (1 + step)])
    inputs = np.stack([np.cos(ends), np.sin(ends), 0 * ends, 0 * ends], axis=1)
    log, slope = hard_case.evaluate(quaternion.log, inputs, dtype, 2)
    assert np.all(abs(log[1] - log[0]) < 16 * step)
    assert np.all(abs(slope[1] - slope[0]) < 16 * step)


LENGTHS = [0, 1e-38, 1e-30, 1e-20, 1e-18, 1e-15, 1e15, 1e25, 3e38]


def _of_any_length(q):
    """What follows, row by row, of one quaternion."""
    return jnp.concatenate(
        [
            quaternion.normalize(q),
            quaternion.to_matrix(q).reshape(9),
            quaternion.log(q),
            quaternion.rotate(q, jnp.asarray(POINT, q.dtype)),
        ]
    )


@pytest.mark.full
def test_any_length_has_finite_value_slope_and_curvature(dtype):
    """A curvature through |q|³ is NaN from 1e-13 down; an unscaled log at 1e-19."""
    inputs = np.array(LENGTHS)[:, None] * WXYZ / np.linalg.norm(WXYZ)
    inputs = np.concatenate([inputs, [[1, 0, 0, 0]]])
    value, slope, curvature = hard_case.evaluate(_of_any_length, inputs, dtype, 3)
    usual, none = value[LENGTHS.index(1e15)], value[-1]
    for length, row in zip(LENGTHS, value, strict=False):
        # float32 flushes 1e-38 to zero, which is no rotation
        expected = usual if length > float(np.finfo(dtype).tiny) else none
        assert np.max(abs(row - expected)) < TIGHT[dtype]
    assert np.all(np.isfinite(slope))
    # it is 1 / length², which float32 cannot hold from 1e-19 down
    least = 0 if dtype == "float64" else 1e-18
    held = [length == 0 or length >= least for length in LENGTHS]
    assert np.all(np.isfinite(curvature[:-1][held]))


def test_lengths_at_the_edge_of_the_range_are_told_apart(dtype):
    """The least normal number is normalized, its neighbor below is the identity."""
    edge = np.finfo(dtype).tiny
    below = np.nextafter(edge, np.asarray(0, dtype))
    inputs = np.array([[0, edge, 0, 0], [0, below, 0, 0]], dtype)
    value = jax.jit(jax.vmap(quaternion.normalize))(inputs)
    assert np.array_equal(value, [[0, 1, 0, 0], [1, 0, 0, 0]])


@pytest.mark.full
def test_ten_thousand_compositions_stay_a_rotation(dtype):
    """Matrices drift from orthogonality and quaternions from length one: 1e-3."""
    turn = np.array([0.01, -0.02, 0.015], dtype)

    @jax.jit
    def compose(turn):
        step = quaternion.exp(turn)

        def composed(_, q):
            return quaternion.normalize(quaternion.multiply(step, q))

        start = quaternion.identity(turn.dtype)
        return jax.lax.fori_loop(0, 10_000, composed, start)

    total = np.asarray(compose(turn))
    assert abs(np.linalg.norm(total) - 1) < 2 * np.finfo(dtype).eps
    truth = Rotation.from_rotvec(10_000 * np.float64(turn))
    rotation = Rotation.from_quat(np.roll(np.asarray(total, np.float64), -1))
    # half an ulp of the step's angle, ten thousand times
    assert (rotation.inv() * truth).magnitude() < 10_000 * 2 * np.finfo(dtype).eps
