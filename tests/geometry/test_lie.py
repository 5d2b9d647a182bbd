"""Rotations and screws against SciPy's matrix exponential and 50-digit arithmetic."""

import jax
import jax.numpy as jnp
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


def screw_matrix(angular, linear):
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = np.cross(np.eye(3), np.asarray(angular, np.float64))
    matrix[:3, 3] = linear
    return matrix


@jax.jit
def exponentials(angular, linear, point):
    return *lie.exp_se3(angular, linear), lie.rotate_point(angular, point)


@pytest.mark.parametrize("angle", [0, 1e-6, 1e-2, 1.0, 3.1, 5.0])
def test_exponentials_match_scipy(angle, float64):
    truth = scipy.linalg.expm(screw_matrix(angle * AXIS, LINEAR))
    rotation, translation, turned = exponentials(angle * AXIS, LINEAR, POINT)
    np.testing.assert_allclose(rotation, truth[:3, :3], atol=1e-14)
    np.testing.assert_allclose(translation, truth[:3, 3], atol=1e-14)
    np.testing.assert_allclose(turned, truth[:3, :3] @ POINT, atol=1e-14)


@jax.jit
@jax.vmap
def log_and_slope(rotation, angular):
    """Of a rotation, and in w of the logarithm of the exponential of w."""
    grad = jax.jacfwd(lambda w: lie.log_so3(lie.exp_so3(w)))
    return lie.log_so3(rotation), grad(angular)


def logarithms(rotations, angular, dtype):
    """NumPy arrays of five rows, as every test asks for, so that programs are shared.

    Fewer rows are repeated.
    """
    rows = np.arange(5) % len(rotations)
    inputs = (np.asarray(x, dtype)[rows] for x in (rotations, angular))
    return [np.asarray(leaf)[: len(rotations)] for leaf in log_and_slope(*inputs)]


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    "angle",
    [0, 1e-20, 1e-8, 1e-4, 1e-2, 0.39, 0.41, 1.5, 3.0, np.pi - 1e-3, np.pi - 1e-6],
)
def test_logarithm_inverts_the_exponential_up_to_pi(angle, dtype, rng):
    axes = rng.normal(size=(5, 3))
    angular = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    angular = angular.astype(dtype).astype(float)
    # the rotation in float64, rounded: the log's own error, not the exponential's
    exact = scipy.spatial.transform.Rotation.from_rotvec(angular)
    logs, grads = logarithms(exact.as_matrix(), angular, dtype)
    error = np.linalg.norm(logs.astype(np.float64) - angular, axis=1)
    # the matrix itself is rounded to 6e-8 in each entry
    assert error.max() < {"float32": 5e-7, "float64": 2e-15}[dtype]
    # d log(exp w) / dw = 1; near π the matrix's rounding may flip the sign
    if angle < 3.1:
        assert np.max(abs(grads - np.eye(3))) < {"float32": 2e-6}.get(dtype, 5e-15)
    else:
        assert np.all(np.isfinite(grads))


@pytest.mark.hard_cases
@pytest.mark.parametrize("axis", np.concatenate([np.eye(3), [[0, 0.6, -0.8]]]))
def test_logarithm_of_a_half_turn(axis, dtype):
    """No sign to choose and no digits to lose: exactly π about ± the axis."""
    turn = 2 * np.outer(axis, axis) - np.eye(3)
    log = logarithms([turn], [np.pi * axis], dtype)[0][0]
    assert np.min([np.max(abs(log - s * np.pi * axis)) for s in (1, -1)]) < 1e-6


screw_and_back = jax.jit(lambda *screw: lie.log_se3(*lie.exp_se3(*screw)))


@pytest.mark.hard_cases
@pytest.mark.parametrize("angle", [0, 1e-8, 1e-3, 1.0, 3.0])
def test_screw_logarithm_inverts_the_exponential(angle, dtype):
    angular, linear = (np.asarray(x, dtype) for x in (angle * AXIS, LINEAR))
    logs = screw_and_back(angular, linear)
    bound = {"float32": 2e-6, "float64": 5e-15}[dtype]  # times θ/2 cot(θ/2) near π
    assert np.max(abs(np.asarray(logs[0]) - angular)) < bound
    assert np.max(abs(np.asarray(logs[1]) - linear)) < bound


@jax.jit
def jacobians(angular, linear):
    return (
        lie.left_jacobian(angular),
        lie.left_jacobian_se3(angular, linear),
        lie.inverse_left_jacobian(angular),
    )


@pytest.mark.hard_cases
@pytest.mark.parametrize("angle", [0, 1e-6, 1e-3, 0.5, 3.0, 3.2, 6.0])
def test_left_jacobians_are_integrals_and_inverse_to_each_other(angle, dtype):
    angular, linear = (np.asarray(x, dtype) for x in (angle * AXIS, LINEAR))
    screw = np.zeros((6, 6))  # the adjoint of (angular, linear)
    hats = [np.cross(np.eye(3), np.asarray(x, np.float64)) for x in (angular, linear)]
    screw[:3, :3] = screw[3:, 3:] = hats[0]
    screw[3:, :3] = hats[1]
    # exp of [[A, 1], [0, 0]] has the integral of exp(tA) from 0 to 1 beside it
    both = np.block([[screw, np.eye(6)], [np.zeros((6, 12))]])
    integral = scipy.linalg.expm(both)[:6, 6:]
    bound = {"float32": 5e-7, "float64": 2e-14}[dtype]
    small, large, small_inverse = jacobians(angular, linear)
    assert np.max(abs(np.asarray(small) - integral[:3, :3])) < bound
    assert np.max(abs(np.asarray(large) - integral)) < bound
    # conditioned like θ/2 / sin(θ/2): 21 at 6 rad
    worse = bound * (400 if angle > 5 else 10)
    truth = np.linalg.inv(integral[:3, :3])
    assert np.max(abs(np.asarray(small_inverse) - truth)) < worse


def test_gradients_of_every_map(float64, rng):
    weight = jnp.asarray(rng.normal(size=(6, 6)))

    def total(angular, linear):
        moved = jnp.concatenate(lie.log_se3(*lie.exp_se3(angular, linear)))
        both = lie.left_jacobian_se3(angular, linear) * weight
        inverse = lie.inverse_left_jacobian(angular) * weight[:3, :3]
        loss = moved @ weight[0] + jnp.sum(moved[:3] ** 3)
        loss += lie.transform_point(angular, linear, jnp.asarray(POINT)) @ weight[1, :3]
        return loss + jnp.sum(both) + jnp.sum(inverse)

    assert gradients.directional_error(total, 0.7 * AXIS, LINEAR) < 1e-7
