"""Stumpff functions against 60-digit arithmetic, value and two derivatives."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from nerfies_jax.geometry.stumpff import SERIES_BELOW, stumpff

EDGE = SERIES_BELOW**0.5
NEAR = [0, 1e-30, 1e-20, 1e-8, 1e-4, 1e-3, 3.3e-3, 1e-2, 0.1, 0.9, 1.1, 2.9]
SEAM = [EDGE * (1 - 1e-7), EDGE, EDGE * (1 + 1e-7)]
ANGLES = np.array([*NEAR, *SEAM, 3.1, np.pi, 4, 2 * np.pi, 10, 100, 1e4, 1e6])


def exact(order, squared, derivative):
    """From the closed forms, which 60 digits afford, and the derivative rule."""
    if derivative:
        return (
            order * exact(order + 2, squared, derivative - 1)
            - exact(order + 1, squared, derivative - 1)
        ) / 2
    if squared < 1e-6:
        return sum((-squared) ** n / mpmath.factorial(2 * n + order) for n in range(8))
    value = mpmath.cos(mpmath.sqrt(squared))
    if order % 2:
        value = mpmath.sin(mpmath.sqrt(squared)) / mpmath.sqrt(squared)
    for k in range(order % 2 + 2, order + 1, 2):
        value = (1 / mpmath.factorial(k - 2) - value) / squared
    return value


@jax.jit
@jax.vmap
def every(squared):
    """Value, slope and curvature of all orders."""

    def orders(squared):
        return jnp.stack([stumpff(order, squared) for order in range(6)])

    grad = jax.jacrev(orders)
    return orders(squared), grad(squared), jax.jacfwd(grad)(squared)


@pytest.mark.hard_cases
@pytest.mark.parametrize("derivative", [0, 1, 2])
@pytest.mark.parametrize("order", range(6))
def test_value_and_derivatives_from_zero_to_a_million_radians(order, derivative, dtype):
    squared = np.asarray(ANGLES**2, dtype)
    got = np.asarray(every(squared)[derivative])[:, order]
    assert got.dtype == dtype
    with mpmath.workdps(60):
        truth = [exact(order, mpmath.mpf(float(s)), derivative) for s in squared]
    # c_k falls like θ^-min(k, 2) and each derivative like another 1/θ; the zeros of the
    # sine make an error relative to the value itself meaningless.
    falls = (1 + np.asarray(squared, np.float64)) ** ((min(order, 2) + derivative) / 2)
    error = np.abs(np.asarray(got, np.float64) - np.array(truth, np.float64)) * falls
    # θ = √s is itself rounded to half an ulp, which the sine sees in full
    bound = {"float32": 3e-7, "float64": 6e-16}[dtype] * (1 + ANGLES / 10)
    assert np.all(error < bound), np.max(error / bound)
