"""Stumpff functions, the coefficients of rotations, smooth in the squared angle."""

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.geometry.precision import at_least_float32

# In rad². The series is used below this bound and the closed form above it. From 3 rad
# on the closed forms of the orders used here do not cancel (up to 7, in second
# derivatives of a screw).
SERIES_BELOW = 9.0
_TERMS = {"float32": 9, "float64": 15}  # relative errors 3e-9 and 3e-20 at 9 rad²


@at_least_float32
def stumpff(order: int, angle_sq: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Evaluate the Stumpff function c_k(s) = Σ (-s)ⁿ / (2n + k)! of s = θ².

    c0 = cos θ, c1 = sin θ / θ, c2 = (1 - cos θ) / θ², c3 = (θ - sin θ) / θ³. The
    argument is θ², since θ = |w| has no derivative at w = 0. Near zero the derivatives
    are Stumpff functions again, so no derivative of any order divides by θ there.

    Args:
      order: The order k, a non-negative integer.
      angle_sq: Squared angles s in rad², non-negative, [...].

    Returns:
      c_k(s), [...].

    References:
      Stumpff 1947.
    """
    near = angle_sq < SERIES_BELOW
    # `where` differentiates both branches, so the unused one must stay finite.
    series = _series(order, jnp.where(near, angle_sq, 0))
    closed_form = _closed_form(order, jnp.where(near, SERIES_BELOW, angle_sq))
    return jnp.where(near, series, closed_form)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _series(order, angle_sq):
    terms = _TERMS[angle_sq.dtype.name]
    total = jnp.full_like(angle_sq, 1 / math.factorial(2 * terms - 2 + order))
    for n in reversed(range(terms - 1)):
        total = 1 / math.factorial(2 * n + order) - angle_sq * total
    return total


@_series.defjvp
def _series_jvp(order, primals, tangents):
    """Evaluate c_k' = (k c_{k+2} - c_{k+1}) / 2 with as many terms as c_k."""
    (angle_sq,), (angle_sq_dot,) = primals, tangents
    grad = -_series(order + 1, angle_sq) / 2
    if order:
        grad = grad + order / 2 * _series(order + 2, angle_sq)
    return _series(order, angle_sq), grad * angle_sq_dot


def _closed_form(order, angle_sq):
    """Evaluate c_k = (1/(k-2)! - c_{k-2}) / s, starting from cos θ or sin θ / θ."""
    angle = jnp.sqrt(angle_sq)
    if order % 2:
        value, start = jnp.sin(angle) / angle, 3
    elif order == 0:
        return jnp.cos(angle)
    else:
        # 2 sin²(θ/2) = 1 - cos θ, without cancellation near multiples of 2π
        value, start = 2 * jnp.sin(angle / 2) ** 2 / angle_sq, 4
    for k in range(start, order + 1, 2):
        value = (1 / math.factorial(k - 2) - value) / angle_sq
    return value
