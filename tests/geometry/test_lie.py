"""Rotations and screws against SciPy's matrix exponential and 50-digit arithmetic."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
import scipy.spatial.transform

from nerfies_jax.geometry import lie
from tests import gradients

ANGLES = [0, 1e-30, 1e-20, 1e-8, 1e-5, 1e-4, 1e-3, 3.3e-3, 1e-2, 0.1, 0.9]
ANGLES += [2.9, 3.0, 3.1, np.pi, 4, 2 * np.pi, 10, 100, 1e4]
AXIS = np.array([2.0, -1.0, 2.0]) / 3
LINEAR = np.array([0.4, -0.2, 0.3])
POINT = np.array([0.5, 0.25, -0.75])

transform = jax.jit(lie.transform_point)
gradient = jax.jit(jax.jacrev(lie.transform_point, argnums=(0, 1, 2)))
hessian = jax.jit(jax.jacfwd(jax.jacrev(lie.transform_point)))


def screw_matrix(angular, linear):
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = np.cross(np.eye(3), np.asarray(angular, np.float64))
    matrix[:3, 3] = linear
    return matrix


def exact_point(angular, linear, point):
    """Rodrigues' closed form in mpmath: with enough digits nothing cancels."""
    w = mpmath.matrix([mpmath.mpf(float(x)) for x in angular])
    v = mpmath.matrix([mpmath.mpf(float(x)) for x in linear])
    x = mpmath.matrix([mpmath.mpf(float(x)) for x in point])
    return _exact_point(w, v, x)


def _exact_point(w, v, x):
    hat = mpmath.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    angle = mpmath.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    if angle == 0:
        return x + v
    one = (1 - mpmath.cos(angle)) / angle**2
    two = (angle - mpmath.sin(angle)) / angle**3
    turned = x + mpmath.sin(angle) / angle * (hat * x) + one * (hat * (hat * x))
    return turned + v + one * (hat * v) + two * (hat * (hat * v))


def exact_derivatives(angular, linear, point):
    """Value, first and second derivative in `angular`, by 120-digit differences."""
    step = mpmath.mpf(10) ** -32
    v, x = (mpmath.matrix([mpmath.mpf(float(c)) for c in y]) for y in (linear, point))
    centre = [mpmath.mpf(float(c)) for c in angular]

    def at(*moves):
        w = list(centre)
        for axis, sign in moves:
            w[axis] += sign * step
        return _exact_point(mpmath.matrix(w), v, x)

    first, second = np.zeros((3, 3)), np.zeros((3, 3, 3))
    for i in range(3):
        slope = (at((i, 1)) - at((i, -1))) / (2 * step)
        first[:, i] = [float(c) for c in slope]
        for j in range(3):
            bend = at((i, 1), (j, 1)) - at((i, 1), (j, -1))
            bend = bend - at((i, -1), (j, 1)) + at((i, -1), (j, -1))
            second[:, i, j] = [float(c / (4 * step**2)) for c in bend]
    return np.array([float(c) for c in at()]), first, second


@pytest.mark.hard_cases
@pytest.mark.parametrize("angle", ANGLES)
def test_a_screw_keeps_value_gradient_and_hessian(angle, dtype):
    inputs = [jnp.asarray(x, dtype) for x in (angle * AXIS, LINEAR, POINT)]
    with mpmath.workdps(120):
        value, first, second = exact_derivatives(*inputs)
    moved = transform(*inputs)
    assert moved.dtype == dtype
    # a few ulps of the lengths; far out, half an ulp of the angle, as in w itself
    bound = {"float32": 5e-7, "float64": 1.5e-15}[dtype] * (1 + angle / 10)
    assert np.max(abs(moved - value)) < bound
    assert np.max(abs(gradient(*inputs)[0] - first)) < bound
    assert np.max(abs(hessian(*inputs) - second)) < bound


@pytest.mark.hard_cases
def test_zero_screw_is_the_identity_and_its_derivative_the_generators(dtype):
    point = jnp.asarray(POINT, dtype)
    zero = jnp.zeros(3, dtype)
    assert np.array_equal(transform(zero, zero, point), point)
    angular, linear, _ = gradient(zero, zero, point)
    assert np.array_equal(angular, np.cross(np.eye(3, dtype=dtype), point).T)
    assert np.array_equal(linear, np.eye(3))


@pytest.mark.hard_cases
@pytest.mark.parametrize("speed", [1e-8, 1e-3, 1.0])
def test_rotation_and_translation_may_vanish_separately(speed, dtype):
    """A translation-dominated warp, where the textbook gradient is 15 % wrong."""
    inputs = [jnp.asarray(x, dtype) for x in (1e-4 * AXIS, speed * LINEAR, POINT)]
    with mpmath.workdps(120):
        _, first, _ = exact_derivatives(*inputs)
    assert np.max(abs(gradient(*inputs)[0] - first)) < {"float32": 2e-7}.get(
        dtype, 1e-15
    )


def test_the_textbook_form_fails_where_this_one_does_not():
    """Nerfies' own lines: NaN at zero, 1 % wrong at 1e-3 rad, in float32."""

    def textbook(angular, linear, point):
        angle = jnp.linalg.norm(angular)
        turn = lie.hat(angular / angle)
        one, two = 1 - jnp.cos(angle), angle - jnp.sin(angle)
        eye = jnp.eye(3)
        rotation = eye + jnp.sin(angle) * turn + one * turn @ turn
        left = angle * eye + one * turn + two * turn @ turn
        return rotation @ point + left @ (linear / angle)

    slope = jax.jacrev(textbook)
    inputs = [jnp.asarray(x, jnp.float32) for x in (1e-3 * AXIS, LINEAR, POINT)]
    assert np.max(abs(slope(*inputs) - gradient(*inputs)[0])) > 1e-3
    assert np.all(np.isnan(slope(jnp.zeros(3), *inputs[1:])))


def test_nerfies_screws(oracle_dir, float64):
    """Reference values with their derivatives, from 1e-8 to 6 rad."""
    values = np.load(oracle_dir / "nerfies.npz")
    inputs = [jnp.asarray(values[f"unit/se3/{name}"]) for name in "wvx"]
    moved = jax.jit(jax.vmap(lie.transform_point))(*inputs)
    truth = "unit/se3/truth64/"
    np.testing.assert_allclose(moved, values[truth + "y"], rtol=1e-12, atol=1e-14)
    slopes = jax.jit(jax.vmap(jax.jacfwd(lie.transform_point, argnums=(0, 1, 2))))(
        *inputs
    )
    for slope, name in zip(slopes, ("dw", "dv", "dx"), strict=True):
        np.testing.assert_allclose(slope, values[truth + name], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("angle", [0, 1e-6, 1e-2, 1.0, 3.1, 5.0])
def test_exponentials_match_scipy(angle, float64):
    angular, linear = jnp.asarray(angle * AXIS), jnp.asarray(LINEAR)
    truth = scipy.linalg.expm(screw_matrix(angular, linear))
    rotation, translation = lie.exp_se3(angular, linear)
    np.testing.assert_allclose(rotation, truth[:3, :3], atol=1e-14)
    np.testing.assert_allclose(translation, truth[:3, 3], atol=1e-14)
    np.testing.assert_allclose(
        lie.rotate_point(angular, jnp.asarray(POINT)), truth[:3, :3] @ POINT, atol=1e-14
    )


log_so3 = jax.jit(lie.log_so3)
log_slope = jax.jit(jax.jacfwd(lambda w: lie.log_so3(lie.exp_so3(w))))


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    "angle",
    [0, 1e-20, 1e-8, 1e-4, 1e-2, 0.39, 0.41, 1.5, 3.0, np.pi - 1e-3, np.pi - 1e-6],
)
def test_logarithm_inverts_the_exponential_up_to_pi(angle, dtype, rng):
    for _ in range(5):
        axis = rng.normal(size=3)
        angular = jnp.asarray(angle * axis / np.linalg.norm(axis), dtype)
        # the rotation in float64, rounded: the log's own error, not the exponential's
        exact = scipy.spatial.transform.Rotation.from_rotvec(np.array(angular, float))
        found = log_so3(jnp.asarray(exact.as_matrix(), dtype))
        error = np.linalg.norm(
            np.asarray(found, np.float64) - np.asarray(angular, float)
        )
        # the matrix itself is rounded to 6e-8 in each entry
        assert error < {"float32": 5e-7, "float64": 2e-15}[dtype]
        # d log(exp w) / dw = 1; near π the matrix's rounding may flip the sign
        if angle < 3.1:
            slope = log_slope(angular)
            assert np.max(abs(slope - np.eye(3))) < {"float32": 2e-6}.get(dtype, 5e-15)
        else:
            assert np.all(np.isfinite(log_slope(angular)))


@pytest.mark.hard_cases
@pytest.mark.parametrize("axis", np.concatenate([np.eye(3), [[0, 0.6, -0.8]]]))
def test_logarithm_of_a_half_turn(axis, dtype):
    """No sign to choose and no digits to lose: exactly π about ± the axis."""
    turn = jnp.asarray(2 * np.outer(axis, axis) - np.eye(3), dtype)
    found = np.asarray(log_so3(turn))
    assert np.min([np.max(abs(found - s * np.pi * axis)) for s in (1, -1)]) < 1e-6


@pytest.mark.hard_cases
@pytest.mark.parametrize("angle", [0, 1e-8, 1e-3, 1.0, 3.0])
def test_screw_logarithm_inverts_the_exponential(angle, dtype):
    angular, linear = jnp.asarray(angle * AXIS, dtype), jnp.asarray(LINEAR, dtype)
    found = lie.log_se3(*lie.exp_se3(angular, linear))
    bound = {"float32": 2e-6, "float64": 5e-15}[dtype]  # times θ/2 cot(θ/2) near π
    assert np.max(abs(found[0] - angular)) < bound
    assert np.max(abs(found[1] - linear)) < bound


@pytest.mark.hard_cases
@pytest.mark.parametrize("angle", [0, 1e-6, 1e-3, 0.5, 3.0, 3.2, 6.0])
def test_left_jacobians_are_integrals_and_inverse_to_each_other(angle, dtype):
    angular, linear = jnp.asarray(angle * AXIS, dtype), jnp.asarray(LINEAR, dtype)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    screw = np.zeros((6, 6))  # the adjoint of (angular, linear)
    hats = [np.cross(np.eye(3), np.asarray(x, np.float64)) for x in (angular, linear)]
    screw[:3, :3] = screw[3:, 3:] = hats[0]
    screw[3:, :3] = hats[1]
    integral = sum(
        w / 2 * scipy.linalg.expm((t + 1) / 2 * screw)
        for t, w in zip(nodes, weights, strict=True)
    )
    bound = {"float32": 5e-7, "float64": 2e-14}[dtype]
    small, large = lie.left_jacobian(angular), lie.left_jacobian_se3(angular, linear)
    assert np.max(abs(small - integral[:3, :3])) < bound
    assert np.max(abs(large - integral)) < bound
    # conditioned like θ/2 / sin(θ/2): 21 at 6 rad
    worse = bound * (400 if angle > 5 else 10)
    truth = np.linalg.inv(integral)
    assert np.max(abs(lie.inverse_left_jacobian(angular) - truth[:3, :3])) < worse
    assert np.max(abs(lie.inverse_left_jacobian_se3(angular, linear) - truth)) < worse


def test_gradients_of_every_map(float64, rng):
    weight = jnp.asarray(rng.normal(size=(6, 6)))
    angular, linear = jnp.asarray(0.7 * AXIS), jnp.asarray(LINEAR)

    def logs(angular, linear):
        moved = lie.log_se3(*lie.exp_se3(angular, linear))
        return jnp.sum(jnp.concatenate(moved) * weight[0]) + jnp.sum(moved[0] ** 3)

    def jacobians(angular, linear):
        both = lie.inverse_left_jacobian_se3(angular, linear) * weight
        return jnp.sum(both) + jnp.sum(lie.left_jacobian(angular) * weight[:3, :3])

    assert gradients.directional_error(logs, angular, linear) < 1e-7
    assert gradients.directional_error(jacobians, angular, linear) < 1e-7
