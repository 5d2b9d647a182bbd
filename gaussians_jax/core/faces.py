"""Conversion between Gaussians and triangles, to view and edit them as a mesh.

Follows GaMeS (Waczyńska et al. 2024, arXiv:2402.01459) as D-MiSo uses it
(arXiv:2405.14276, section 3). The first corner is the mean, and the other two are the
ends of the second and third axes. The first scale, across the face, is tiny and fixed.
It is not part of the triangle and is stored separately.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gaussians_jax.core.splats import Gaussians
from nerfies_jax.geometry import quaternion

Vector = Float[Array, "3"]
# Edges count as collinear if the sine of their angle is below this many machine
# epsilons. The rejection of one from the other is then only rounding error.
ONE_LINE = 8


def corners(gaussians: Gaussians) -> Float[Array, "gaussians 3 3"]:
    """Convert Gaussians to triangles: the mean and the ends of two axes.

    Args:
      gaussians: The Gaussians.

    Returns:
      The three corners of each Gaussian in scene units.
    """
    axes = jax.vmap(quaternion.to_matrix)(gaussians.quaternion)
    ends = jnp.swapaxes(axes * gaussians.scale[:, None], 1, 2)[:, 1:]
    first = gaussians.mean[:, None]
    return jnp.concatenate([first, first + ends], axis=1)


def gaussians(
    corners: Float[Array, "gaussians 3 3"],
    thickness: Float[Array, " gaussians"],
    opacity: Float[Array, " gaussians"],
) -> Gaussians:
    """Convert triangles to Gaussians.

    If the edges are not perpendicular, the second axis is the rejection of the second
    edge from the first, as in GaMeS. Triangles without area have a third scale of zero,
    and points a second one as well. Undetermined axes are arbitrary, without a
    gradient.

    Args:
      corners: Corners in scene units.
      thickness: Scale across each triangle in scene units.
      opacity: Opacity in [0, 1].

    Returns:
      The Gaussians.
    """
    edges = corners[:, 1:] - corners[:, :1]
    turn, length = jax.vmap(_face)(edges[:, 0], edges[:, 1])
    scale = jnp.concatenate([thickness[:, None], length], axis=1)
    return Gaussians(corners[:, 0], turn, scale, opacity)


def _face(first, second):
    """Return the rotation of two edges as a quaternion, and the scales along them."""
    first_axis, length = _unit(first)
    second_axis, second_length = _unit(second)
    # If the first edge has no length, the second one determines the axes.
    first_axis = jnp.where(length > 0, first_axis, _across(second_axis))
    rejection = _reject(second_axis, first_axis)
    collinear = jnp.max(jnp.abs(rejection)) < ONE_LINE * jnp.finfo(first_axis.dtype).eps
    rejection = jnp.where(collinear, _across(first_axis), rejection)
    rejection, _ = _unit(rejection)
    # Repeated, because the first rejection is mostly rounding if the edges are almost
    # collinear.
    rejection, _ = _unit(_reject(rejection, first_axis))
    axes = jnp.stack([jnp.cross(first_axis, rejection), first_axis, rejection], axis=1)
    width = jnp.where(collinear, 0, second_length * jnp.sum(second_axis * rejection))
    return quaternion.from_matrix(axes), jnp.stack([length, width])


def _unit(vector):
    """Return direction and length; the x axis and zero for a zero vector."""
    largest = jnp.max(jnp.abs(vector))
    is_zero = largest < jnp.finfo(vector.dtype).tiny
    # Scaled first, because squares underflow in float32 below 1e-19.
    divisor = jnp.where(is_zero, 1, jax.lax.stop_gradient(largest))
    scaled_vector = jnp.where(
        is_zero, jnp.eye(3, dtype=vector.dtype)[0], vector / divisor
    )
    length = jnp.sqrt(jnp.sum(scaled_vector * scaled_vector))
    return scaled_vector / length, jnp.where(is_zero, 0, length * divisor)


def _reject(vector: Vector, unit: Vector) -> Vector:
    """Return the part of a vector that is perpendicular to a direction."""
    return vector - jnp.sum(vector * unit) * unit


def _across(unit):
    """Return some direction perpendicular to another, without a gradient."""
    unit = jax.lax.stop_gradient(unit)
    least = jax.nn.one_hot(jnp.argmin(jnp.abs(unit)), 3, dtype=unit.dtype)
    return _unit(jnp.cross(unit, least))[0]
