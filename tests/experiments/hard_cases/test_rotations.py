"""Rotations and screws at their hard points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform
from hypothesis import given, settings
from hypothesis import strategies as st

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


def test_values_are_held():
    checks.hold_values(CASES)


@checks.by_case(CASES)
def test_held(case, dtype):
    checks.hold(case, dtype)


@pytest.mark.full
def test_one_alone_is_held():
    checks.hold_alone(CASES)


@checks.each(CASES)
def test_the_textbook_form_is_caught(case):
    checks.catches_the_textbook(case)


# Every public function of rotations, on vectors of three and quaternions.
VECTORS = (0.3 * rotations.AXIS, LINEAR, POINT)
EVERY = {
    "stumpff": (lambda s: stumpff(3, s), (np.array(0.7),)),
    "transform_point": (lie.transform_point, VECTORS),
    "displacement": (lie.displacement, VECTORS),
    "rotate_point": (lie.rotate_point, VECTORS[::2]),
    "exp_so3": (lie.exp_so3, VECTORS[:1]),
    "log_so3": (lie.log_so3, (Rotation.from_rotvec(VECTORS[0]).as_matrix(),)),
    "exp_se3": (lie.exp_se3, VECTORS[:2]),
    "log_se3": (
        lie.log_se3,
        (Rotation.from_rotvec(VECTORS[0]).as_matrix(), LINEAR),
    ),
    "left_jacobian": (lie.left_jacobian, VECTORS[:1]),
    "inverse_left_jacobian": (lie.inverse_left_jacobian, VECTORS[:1]),
    "left_jacobian_se3": (lie.left_jacobian_se3, VECTORS[:2]),
    "hat": (lie.hat, VECTORS[:1]),
    "normalise": (quaternion.normalise, (WXYZ,)),
    "multiply": (quaternion.multiply, (WXYZ, WXYZ[::-1])),
    "conjugate": (quaternion.conjugate, (WXYZ,)),
    "rotate": (quaternion.rotate, (WXYZ, POINT)),
    "to_matrix": (quaternion.to_matrix, (WXYZ,)),
    "from_matrix": (
        quaternion.from_matrix,
        (Rotation.from_rotvec([2, -2, 1]).as_matrix(),),
    ),
    "exp": (quaternion.exp, VECTORS[:1]),
    "log": (quaternion.log, (WXYZ,)),
    "slerp": (quaternion.slerp, (WXYZ, WXYZ[::-1], np.array(0.25))),
}


@jax.jit
def every(inputs):
    """All of them in one program: 21 take half as long again to compile."""
    return {name: EVERY[name][0](*args) for name, args in inputs.items()}


def inputs_of(kind):
    return {
        name: tuple(np.asarray(arg).astype(jnp.dtype(kind)) for arg in args)
        for name, (_, args) in EVERY.items()
    }


def joined(results):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(results)])


@pytest.mark.full
@pytest.mark.parametrize("kind", ["bfloat16", "float16"])
def test_half_precision_is_rounded_once(kind):
    """Computed in float32 from the same inputs; in bfloat16 a screw is 3e-2 off."""
    half = inputs_of(kind)
    found = every(half)
    exact = every(jax.tree.map(lambda x: x.astype(np.float32), half))
    half_ulp = float(jnp.finfo(kind).eps) / 2
    for name, results in found.items():
        assert all(leaf.dtype == kind for leaf in jax.tree.leaves(results)), name
        expected = joined(exact[name])
        off = np.abs(joined(results).astype(np.float32) - expected)
        # float16's smallest numbers are 6e-8 apart
        assert np.all(off <= 1.001 * half_ulp * np.abs(expected) + 6e-8), name


@pytest.mark.full
def test_a_float32_point_moved_by_a_bfloat16_screw_stays_float32():
    screw = [x.astype(jnp.bfloat16) for x in (0.3 * rotations.AXIS, LINEAR)]
    point = POINT.astype(np.float32)
    transform = jax.jit(lie.transform_point)
    moved = transform(*screw, point)
    wide = transform(*(x.astype(np.float32) for x in screw), point)
    assert moved.dtype == jnp.float32
    assert np.array_equal(moved, wide)


@pytest.mark.full
def test_float32_stays_float32_with_x64_on_and_every_way_of_calling_agrees():
    """Constants made under x64 would turn float32 arguments into float64."""
    inputs = inputs_of("float32")
    with jax.enable_x64(True):
        wide = every(inputs)
        rows = jax.jit(jax.vmap(every))(
            jax.tree.map(lambda x: np.stack([x, x]), inputs)
        )
    for name, (function, _) in EVERY.items():
        eager = joined(function(*map(jnp.asarray, inputs[name])))
        row = jax.tree.map(lambda leaf: np.asarray(leaf)[1], rows[name])
        for other in (wide[name], row):
            other = joined(other)
            assert other.dtype == np.float32, name
            np.testing.assert_allclose(other, eager, atol=4e-7, err_msg=name)


def _every_degree(x):
    return jnp.stack([stumpff(degree, x[0]) for degree in range(6)])


def test_stumpff_functions_are_continuous_across_their_switch(dtype):
    """Neighbouring numbers, one by the series and one by the closed form."""
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
    given = np.stack([np.cos(ends), np.sin(ends), 0 * ends, 0 * ends], axis=1)
    log, slope = hard_case.evaluate(quaternion.log, given, dtype, 2)
    assert np.all(abs(log[1] - log[0]) < 16 * step)
    assert np.all(abs(slope[1] - slope[0]) < 16 * step)


LENGTHS = [0, 1e-38, 1e-30, 1e-20, 1e-18, 1e-15, 1e15, 1e25, 3e38]


def _of_any_length(q):
    """What follows, row by row, of one quaternion."""
    return jnp.concatenate(
        [
            quaternion.normalise(q),
            quaternion.to_matrix(q).reshape(9),
            quaternion.log(q),
            quaternion.rotate(q, jnp.asarray(POINT, q.dtype)),
        ]
    )


@pytest.mark.full
def test_any_length_has_finite_value_slope_and_curvature(dtype):
    """A curvature through |q|³ is NaN from 1e-13 down; an unscaled log at 1e-19."""
    given = np.array(LENGTHS)[:, None] * WXYZ / np.linalg.norm(WXYZ)
    given = np.concatenate([given, [[1, 0, 0, 0]]])
    value, slope, curvature = hard_case.evaluate(_of_any_length, given, dtype, 3)
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
    """The least normal number is normalised, its neighbour below is the identity."""
    edge = np.finfo(dtype).tiny
    below = np.nextafter(edge, np.asarray(0, dtype))
    given = np.array([[0, edge, 0, 0], [0, below, 0, 0]], dtype)
    value = jax.jit(jax.vmap(quaternion.normalise))(given)
    assert np.array_equal(value, [[0, 1, 0, 0], [1, 0, 0, 0]])


@jax.jit
def with_a_residual(own, residual, angular):
    """Their sum normalised, its slope in the residual, and `own` turned instead."""

    def total(residual):
        return quaternion.normalise(own + residual)

    turned = quaternion.multiply(quaternion.exp(angular), own)
    return total(residual), jax.jacrev(total)(residual), turned


@pytest.mark.parametrize("rest", [1e-1, 1e-3, 1e-6, 0])
def test_a_residual_that_nearly_cancels_its_quaternion_gives_a_rotation(rest, dtype):
    """q + dq of length `rest`: rounding decides which, its slope is at most 1/rest.

    Multiplying by an exponential has neither trouble, for any residual.
    """
    unit = WXYZ / np.linalg.norm(WXYZ)
    other = -unit + rest * np.array([0.5, 0.5, -0.5, 0.5])
    total, slope, turned = (
        np.asarray(found)
        for found in with_a_residual(
            *(x.astype(dtype) for x in (unit, other, 3 * POINT))
        )
    )
    assert abs(np.linalg.norm(total) - 1) < TIGHT[dtype]
    assert np.all(np.isfinite(slope))
    if rest:
        assert np.max(abs(slope)) < 1.1 / rest
    assert abs(np.linalg.norm(turned) - 1) < TIGHT[dtype]


@pytest.mark.full
def test_ten_thousand_compositions_stay_a_rotation(dtype):
    """Matrices drift from orthogonality and quaternions from length one: 1e-3."""
    turn = np.array([0.01, -0.02, 0.015], dtype)

    @jax.jit
    def compose(turn):
        step = quaternion.exp(turn)

        def composed(_, q):
            return quaternion.normalise(quaternion.multiply(step, q))

        start = quaternion.identity(turn.dtype)
        return jax.lax.fori_loop(0, 10_000, composed, start)

    total = np.asarray(compose(turn))
    assert abs(np.linalg.norm(total) - 1) < 2 * np.finfo(dtype).eps
    truth = Rotation.from_rotvec(10_000 * np.float64(turn))
    found = Rotation.from_quat(np.roll(np.asarray(total, np.float64), -1))
    # half an ulp of the step's angle, ten thousand times
    assert (found.inv() * truth).magnitude() < 10_000 * 2 * np.finfo(dtype).eps


numbers = st.floats(-3, 3, width=32)
triples = st.tuples(numbers, numbers, numbers)
axioms = settings(max_examples=40, deadline=None, derandomize=True, database=None)
both = pytest.mark.parametrize("kind", ["float32", "float64"])


@jax.jit
def _group(one, two, three, linear, point):
    """What should vanish, by name."""
    a, b, c = (quaternion.exp(w) for w in (one, two, three))
    times, inverse = quaternion.multiply, quaternion.conjugate
    screw = lie.transform_point(one, linear, point)
    half = lie.transform_point(one / 2, linear / 2, point)
    apart = lie.transform_point(one, linear, point + two)
    rotation, shift = lie.exp_se3(one, linear)
    return {
        "associative": times(times(a, b), c) - times(a, times(b, c)),
        "neutral": times(a, quaternion.identity(a.dtype)) - a,
        "inverse": times(a, inverse(a)) - quaternion.identity(a.dtype),
        "opposite": quaternion.exp(-one) - inverse(a),
        "matrices": quaternion.to_matrix(times(a, b))
        - quaternion.to_matrix(a) @ quaternion.to_matrix(b),
        "signs": quaternion.to_matrix(-a) - quaternion.to_matrix(a),
        "exponentials": quaternion.to_matrix(a) - lie.exp_so3(one),
        "screw and matrix": screw - (rotation @ point + shift),
        "screw back": lie.transform_point(-one, -linear, screw) - point,
        "two halves": lie.transform_point(one / 2, linear / 2, half) - screw,
        "lengths": jnp.sum((apart - screw) ** 2) - jnp.sum(two**2),
        "adjoint": lie.left_jacobian(one) @ two
        - lie.exp_so3(one) @ lie.left_jacobian(-one) @ two,
    }


@pytest.mark.full
@both
@axioms
@given(one=triples, two=triples, three=triples, linear=triples, point=triples)
def test_rotations_and_screws_are_groups(kind, one, two, three, linear, point):
    with jax.enable_x64(kind == "float64"):
        args = [np.asarray(x, kind) for x in (one, two, three, linear, point)]
        for name, rest in _group(*args).items():
            # of points up to 15 units away and squares up to 30
            assert np.max(abs(np.asarray(rest))) < 10 * TIGHT[kind], name
