"""Rays: pixels to rays, distances along them, where they enter and leave.

Samples lie at *distances* along unit directions; pictures, captures and meshes speak of
*z-depth* along the viewing axis. The two differ by a cosine (`depth_per_distance`), up
to 1.3 times in the corner of a phone's picture.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nerfies_jax.contract import checked
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera

# A component of a unit direction, below which the ray runs along the face. 1e-20 would
# have quotients that are finite and slopes, over 1e-40, that are not in float32.
PARALLEL = 1e-12


class Rays(NamedTuple):
    """Rays in world coordinates; one, or a batch along leading axes."""

    origin: Float[Array, "*rays 3"]  # scene units
    direction: Float[Array, "*rays 3"]  # unit length
    valid: Bool[Array, "*rays"]  # False where the lens model has no ray for the pixel


@checked(broadcast=True)
def pixel_ray(camera: Camera, pixel: Float[Array, "2"]) -> Rays:
    """The ray of one pixel position; column i, row j is centered on (i + ½, j + ½)."""
    direction, converged = cameras.unproject(camera, pixel)
    return Rays(jnp.asarray(camera.position), direction, converged)


@checked(broadcast=True)
def pixel_rays(camera: Camera, size: tuple[int, int]) -> Rays:
    """Rays [height, width] through the pixel centers of a (width, height) picture."""
    return jax.vmap(jax.vmap(lambda pixel: pixel_ray(camera, pixel)))(
        pixel_centers(size, camera.position.dtype)
    )


def pixel_centers(size: tuple[int, int], dtype=jnp.float32) -> Float[Array, "h w 2"]:
    """Positions (column + ½, row + ½) of all pixels of a (width, height) picture."""
    width, height = size
    columns, rows = jnp.meshgrid(
        jnp.arange(width, dtype=dtype), jnp.arange(height, dtype=dtype)
    )
    return jnp.stack([columns, rows], axis=-1) + 0.5


def point_at(
    origin: Float[Array, "3"], direction: Float[Array, "3"], distance: Float[Array, ""]
) -> Float[Array, "3"]:
    """The point at one distance along one ray."""
    return origin + distance * direction


def across_ray(unit: Float[np.ndarray, "*rays 3"]) -> Float[np.ndarray, "*rays 3 3"]:
    """What a vector has across the unit direction, 1 - u uᵀ; host side, in float64."""
    return np.eye(3) - unit[..., :, None] * unit[..., None, :]


def depth_per_distance(
    camera: Camera, direction: Float[Array, "*rays 3"]
) -> Float[Array, "*rays"]:
    """Cosine between rays and the viewing axis: z-depth = cosine × distance.

    Positive for every ray that `pixel_rays` calls valid.
    """
    return jnp.sum(direction * cameras.forward_axis(camera), axis=-1)


def depth_of_distance(
    camera: Camera, direction: Float[Array, "*rays 3"], distance: Float[Array, "*rays"]
) -> Float[Array, "*rays"]:
    """z-depth of what lies at `distance` along rays of one camera."""
    return distance * depth_per_distance(camera, direction)


def distance_of_depth(
    camera: Camera, direction: Float[Array, "*rays 3"], depth: Float[Array, "*rays"]
) -> Float[Array, "*rays"]:
    """Distance along rays of one camera at which they reach a z-depth."""
    return depth / depth_per_distance(camera, direction)


def intersect_aabb(
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    low: Float[Array, "3"],
    high: Float[Array, "3"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Distances at which one ray enters and leaves an axis-aligned box.

    The ray starts at its origin, so the entry is not negative; a ray that misses has an
    entry that is not below its exit. The slab test of Kay and Kajiya 1986.
    """
    # A component of 0 never crosses its two planes; a quotient by 0 would be 0/0 where
    # the origin lies in one of them.
    moving = jnp.abs(direction) > PARALLEL
    divisor = jnp.where(moving, direction, 1)
    first, second = (low - origin) / divisor, (high - origin) / divisor
    inside = (origin >= low) & (origin <= high)
    enter = jnp.where(moving, jnp.minimum(first, second), jnp.where(inside, 0, jnp.inf))
    leave = jnp.where(moving, jnp.maximum(first, second), jnp.inf)
    return jnp.maximum(jnp.max(enter), 0), jnp.min(leave)
