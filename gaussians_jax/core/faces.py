"""Conversion between Gaussians and triangles, to view and edit them as a mesh.

GaMeS (Waczyńska et al. 2024, arXiv:2402.01459), as D-MiSo uses it (arXiv:2405.14276,
section 3): the first corner is the mean, and the other two are the ends of the second
and third axes. A triangle does not contain the first scale, across the face, which is
tiny and fixed there and is stored separately.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gaussians_jax.core.splats import Gaussians
from nerfies_jax.geometry import quaternion

Vector = Float[Array, "3"]
# Of the sine between two edges, in units of its precision: below, they count as one
# line. The rest of the edge is then rounding.
ONE_LINE = 8


def corners(gaussians: Gaussians) -> Float[Array, "gaussians 3 3"]:
    """The three corners of each, scene units: the mean, and the ends of two axes."""
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
    """The rotation of two edges as a quaternion, and the scales along them."""
    one, length = _unit(first)
    other, far = _unit(second)
    # A first edge without a length leaves all to the second one.
    one = jnp.where(length > 0, one, _across(other))
    across = _rejected(other, one)
    flat = jnp.max(jnp.abs(across)) < ONE_LINE * jnp.finfo(one.dtype).eps
    across = jnp.where(flat, _across(one), across)
    across, _ = _unit(across)
    # Once more: where edges are all but one line, the rest is mostly rounding.
    across, _ = _unit(_rejected(across, one))
    axes = jnp.stack([jnp.cross(one, across), one, across], axis=1)
    width = jnp.where(flat, 0, far * jnp.sum(other * across))
    return quaternion.from_matrix(axes), jnp.stack([length, width])


def _unit(vector):
    """Return direction and length; the x axis and zero for a zero vector."""
    largest = jnp.max(jnp.abs(vector))
    nothing = largest < jnp.finfo(vector.dtype).tiny
    # Scaled first: in float32 squares are lost from 1e-19 down.
    held = jnp.where(nothing, 1, jax.lax.stop_gradient(largest))
    away = jnp.where(nothing, jnp.eye(3, dtype=vector.dtype)[0], vector / held)
    length = jnp.sqrt(jnp.sum(away * away))
    return away / length, jnp.where(nothing, 0, length * held)


def _rejected(vector: Vector, unit: Vector) -> Vector:
    """Return the part of a vector that is perpendicular to a direction."""
    return vector - jnp.sum(vector * unit) * unit


def _across(unit):
    """Return some direction perpendicular to another, without a gradient."""
    unit = jax.lax.stop_gradient(unit)
    least = jax.nn.one_hot(jnp.argmin(jnp.abs(unit)), 3, dtype=unit.dtype)
    return _unit(jnp.cross(unit, least))[0]
