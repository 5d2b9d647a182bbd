"""Rays of pixels, distances along them, and intersections with boxes.

Samples lie at *distances* along unit directions. Images, captures and meshes use
*z-depth* along the viewing axis. The two differ by a cosine (`depth_per_distance`), up
to a factor of 1.3 in the corner of a phone's image.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.runtime.contract import checked

# A ray counts as parallel to a face if this component of its unit direction is smaller.
# With 1e-20 the distances would be finite in float32, but not their gradients, which
# divide by its square.
PARALLEL = 1e-12


class Rays(NamedTuple):
    """Rays in world coordinates, one or a batch along leading axes."""

    origin: Float[Array, "*rays 3"]  # scene units
    direction: Float[Array, "*rays 3"]  # unit length
    valid: Bool[Array, "*rays"]  # False where the lens model has no ray for the pixel


@checked(broadcast=True)
def pixel_ray(camera: Camera, pixel: Float[Array, "2"]) -> Rays:
    """Compute the ray of pixel positions.

    Args:
      camera: Cameras, [...].
      pixel: Positions (x, y), [..., 2]. The pixel in column i and row j is centered on
        (i + 0.5, j + 0.5).

    Returns:
      Rays with leading axes [...].
    """
    direction, has_solution = cameras.unproject(camera, pixel)
    return Rays(jnp.asarray(camera.position), direction, has_solution)


@checked(broadcast=True)
def pixel_rays(camera: Camera, size: tuple[int, int]) -> Rays:
    """Compute the rays through all pixel centers of an image.

    Args:
      camera: Cameras, [...].
      size: Width and height of the image in pixels.

    Returns:
      Rays with leading axes [..., height, width].
    """
    return jax.vmap(jax.vmap(lambda pixel: pixel_ray(camera, pixel)))(
        pixel_centers(size, camera.position.dtype)
    )


def pixel_centers(
    size: tuple[int, int], dtype: DTypeLike = jnp.float32
) -> Float[Array, "h w 2"]:
    """Return the positions (column + 0.5, row + 0.5) of all pixels of an image.

    Args:
      size: Width and height of the image in pixels.
      dtype: Floating-point type of the result.

    Returns:
      Positions (x, y), [height, width, 2].
    """
    width, height = size
    columns, rows = jnp.meshgrid(
        jnp.arange(width, dtype=dtype), jnp.arange(height, dtype=dtype)
    )
    return jnp.stack([columns, rows], axis=-1) + 0.5


def point_at(
    origin: Float[Array, "3"], direction: Float[Array, "3"], distance: Float[Array, ""]
) -> Float[Array, "3"]:
    """Return the point at a distance along one ray.

    Args:
      origin: Origin of the ray in scene units, [3].
      direction: Unit direction, [3].
      distance: Distance from the origin in scene units, a scalar.

    Returns:
      The point, [3].
    """
    return origin + distance * direction


def across_ray(unit: Float[np.ndarray, "*rays 3"]) -> Float[np.ndarray, "*rays 3 3"]:
    """Return projectors onto the planes perpendicular to rays, 1 - u uᵀ, on the host.

    Args:
      unit: Unit directions u, [..., 3].

    Returns:
      Symmetric matrices in float64, [..., 3, 3].
    """
    return np.eye(3) - unit[..., :, None] * unit[..., None, :]


def depth_per_distance(
    camera: Camera, direction: Float[Array, "*rays 3"]
) -> Float[Array, "*rays"]:
    """Compute the cosine between rays and the viewing axis, z-depth per distance.

    Args:
      camera: One camera, or a batch that broadcasts with the rays.
      direction: Unit directions in the world, [..., 3].

    Returns:
      Cosines [...], positive for every ray that `pixel_rays` marks valid.
    """
    return jnp.sum(direction * cameras.forward_axis(camera), axis=-1)


def depth_of_distance(
    camera: Camera, direction: Float[Array, "*rays 3"], distance: Float[Array, "*rays"]
) -> Float[Array, "*rays"]:
    """Convert distances along rays to z-depths.

    Args:
      camera: The camera of the rays.
      direction: Unit directions in the world, [..., 3].
      distance: Distances in scene units, [...].

    Returns:
      z-depths in scene units, [...].
    """
    return distance * depth_per_distance(camera, direction)


def distance_of_depth(
    camera: Camera, direction: Float[Array, "*rays 3"], depth: Float[Array, "*rays"]
) -> Float[Array, "*rays"]:
    """Convert z-depths to distances along rays.

    Args:
      camera: The camera of the rays.
      direction: Unit directions in the world, [..., 3].
      depth: z-depths in scene units, [...].

    Returns:
      Distances in scene units, [...].
    """
    return depth / depth_per_distance(camera, direction)


def intersect_aabb(
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    low: Float[Array, "3"],
    high: Float[Array, "3"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Intersect one ray with an axis-aligned box.

    Args:
      origin: Origin of the ray in scene units, [3].
      direction: Unit direction, [3].
      low: Lower corner of the box, [3].
      high: Upper corner of the box, [3].

    Returns:
      Distances at which the ray enters and leaves. The ray starts at its origin, so the
      entry is not negative. For a ray that misses, the entry is not below the exit.

    References:
      The slab test of Kay and Kajiya 1986.
    """
    # A parallel ray crosses neither of the two planes. The quotient would be 0/0 if the
    # origin lies in one of them.
    crosses = jnp.abs(direction) > PARALLEL
    divisor = jnp.where(crosses, direction, 1)
    first, second = (low - origin) / divisor, (high - origin) / divisor
    inside = (origin >= low) & (origin <= high)
    enter = jnp.where(
        crosses, jnp.minimum(first, second), jnp.where(inside, 0, jnp.inf)
    )
    leave = jnp.where(crosses, jnp.maximum(first, second), jnp.inf)
    return jnp.maximum(jnp.max(enter), 0), jnp.min(leave)
