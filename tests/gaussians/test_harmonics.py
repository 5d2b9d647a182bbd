"""Spherical harmonics against SciPy's, and the zero direction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from gaussians_jax.splatting import harmonics
from tests import gradients
from tests.gaussians.shared import full, jitted, put


def scipy_basis(direction, degree):
    """Real harmonics with the Condon-Shortley phase, order m = -l .. l."""
    x, y, z = direction.T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    terms = []
    for order in range(degree + 1):
        for m in range(-order, order + 1):
            value = scipy.special.sph_harm_y(order, abs(m), polar, azimuth)
            part = value.real if m >= 0 else value.imag
            terms.append(part * (1 if m == 0 else np.sqrt(2)))
    return np.stack(terms, -1)


@pytest.mark.parametrize("degree", [3, *full(0, 1, 2)])
def test_basis_equals_scipy(degree, dtype, rng):
    direction = rng.normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    evaluate = jitted(lambda d: jnp.stack(harmonics.basis(d, degree), -1))
    basis = evaluate(direction.astype(dtype))
    assert basis.dtype == dtype
    # Cubic terms of coefficients up to 2.9: ten ulps.
    tolerance = {"float32": 2e-6, "float64": 5e-15}[dtype]
    np.testing.assert_allclose(basis, scipy_basis(direction, degree), atol=tolerance)


@jax.jit
def value_and_jacobian(offset):
    function = harmonics.unit_direction
    return function(offset), jax.jacrev(function)(offset)


@pytest.mark.hard_cases
@pytest.mark.parametrize("part", [0.0, np.nan, np.inf, -np.inf])
def test_no_direction_looks_along_z_and_has_no_gradient(part, dtype):
    value, jacobian = value_and_jacobian(np.array([0, part, 0], dtype))
    np.testing.assert_array_equal(value, [0, 0, 1])
    np.testing.assert_array_equal(jacobian, np.zeros((3, 3)))


def test_color_is_clamped_at_zero_from_below(dtype, rng):
    coefficients = rng.normal(size=(50, 16, 3)).astype(dtype)
    mean, position = rng.normal(size=(50, 3)), np.array([0.5, -2.0, 1.0])
    color = jitted(harmonics.color_toward)(
        coefficients, mean.astype(dtype), position.astype(dtype)
    )
    direction = mean - position
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    expected = np.einsum(
        "nk,nkc->nc", scipy_basis(direction, 3), coefficients.astype(float)
    )
    assert (expected < -0.5).any()
    tolerance = {"float32": 1e-5, "float64": 1e-13}[dtype]
    np.testing.assert_allclose(color, np.maximum(expected + 0.5, 0), atol=tolerance)


def test_color_gradient_equals_central_differences(float64, rng):
    coefficients = put(0.1 * rng.normal(size=(5, 16, 3)))
    mean, position = put(rng.normal(size=(5, 3))), put([3.0, 1.0, 2.0])
    weights = rng.normal(size=(5, 3))

    def loss(*args):
        return jnp.sum(harmonics.color_toward(*args) * weights)

    assert gradients.directional_error(loss, coefficients, mean, position) < 1e-8
