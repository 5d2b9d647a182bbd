"""Gaussians as triangles, and triangles as Gaussians: to see and edit them as a mesh.

GaMeS (Waczyńska et al. 2024, arXiv:2402.01459), as D-MiSo uses it (arXiv:2405.14276,
section 3): the first corner is the mean, the other two are where the second and the
third axis end. The first scale, across the face, is not in a triangle (there it is
tiny and fixed) and goes beside it.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gaussians_jax.splats import Gaussians
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
    """The Gaussians of triangles, `thickness` (scene units) across them.

    Of edges that are not at right angles the second is the part that is across the
    first, as in GaMeS. Of a triangle without an area the third scale is zero, of a
    point the second as well; axes that it does not say are any, and have no slope.
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
    """A direction and a length; of zero the first axis of the world, and zero."""
    largest = jnp.max(jnp.abs(vector))
    nothing = largest < jnp.finfo(vector.dtype).tiny
    # Scaled first: in float32 squares are lost from 1e-19 down.
    held = jnp.where(nothing, 1, jax.lax.stop_gradient(largest))
    away = jnp.where(nothing, jnp.eye(3, dtype=vector.dtype)[0], vector / held)
    length = jnp.sqrt(jnp.sum(away * away))
    return away / length, jnp.where(nothing, 0, length * held)


def _rejected(vector: Vector, unit: Vector) -> Vector:
    """What of a vector is across a direction."""
    return vector - jnp.sum(vector * unit) * unit


def _across(unit):
    """Some direction across another, without a slope."""
    unit = jax.lax.stop_gradient(unit)
    least = jax.nn.one_hot(jnp.argmin(jnp.abs(unit)), 3, dtype=unit.dtype)
    return _unit(jnp.cross(unit, least))[0]
