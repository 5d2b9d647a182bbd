"""Displacements of warps on a grid in the frustum of one frame, interpolated.

A frame has millions of samples, and a warp is smooth in space. It is evaluated at the
vertices of a grid along rays of the image and interpolated linearly in column, row and
relative depth. Without lens distortion, a displacement that is linear in space is
reproduced exactly.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.fields.field_ray import Ray, field_ray_through
from nerfies_jax.fields.render_ray import Bound, displacement
from nerfies_jax.geometry import rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training.effects import FrameCondition

# Cells along the longer side of the image, and in depth. PSNR of frames of 256x192
# pixels relative to full quadrature, and milliseconds on one core of a 2.5 GHz Xeon:
#   `d-nerf-grid-small`, built-in scene, 400 steps, every sample   72 to 74 dB in 1,640
#     32 across, 64 deep                                           50 to 51        870
#     48 and 64                                                    54 to 55        930
#     64 and 64                                                    56 to 57      1,000
#     64 and 128                                                   59 to 60      1,100
#   `nerfies-grid-small`, bookshelf, 300 steps, every sample     100 to 111      1,760
#     48 and 64                                                    60 to 69        980
# The survey and the template alone take about 800 ms. With ambient coordinates on the
# grid (7 cells per wavelength) it is 41 dB. Evaluating them at every sample takes as
# long as the warp saves.
ACROSS, DEEP = 48, 64
CELLS_A_WAVE = 16  # minimum number of cells per shortest wavelength to use the grid

Grid = Float[Array, "rows columns corners 3"]


def resolves(bound: Bound) -> bool:
    """Return whether warps alone move a field, with wavelengths much larger than cells.

    Fields with `trunk_features` or `point_codes` hooks are excluded, because evaluating
    these at every sample takes as long. The wavelength of an effect is its
    `FieldRecord.shortest_wave`, if known.

    Args:
      bound: The field with its parameters.

    Returns:
      True if the grid can replace evaluation at every sample.
    """
    metadata = bound.metadata.concrete
    cell = (metadata.far - metadata.near) * metadata.scale / DEEP
    if any(effect.trunk_features or effect.point_codes for effect in bound.effects):
        return False
    waves = [e.shortest_wave for e in bound.effects if e.displace is not None]
    wavelengths = [wave for wave in waves if wave is not None]
    if not waves or len(wavelengths) < len(waves):
        return False
    return bool(CELLS_A_WAVE * cell <= min(wavelengths))


def displacements(
    bound: Bound, camera: Camera, condition: FrameCondition, size: tuple[int, int]
) -> Grid:
    """Evaluate the warps at all vertices between near and far.

    Args:
      bound: The field with its parameters.
      camera: The camera.
      condition: Conditioning of the frame.
      size: Width and height of the image in pixels.

    Returns:
      Template point minus observed point in units of the field, [rows, columns,
      corners, 3].
    """
    cell = max(*size, ACROSS) / ACROSS  # a pixel or more
    dtype = camera.position.dtype
    columns, rows = (
        jnp.linspace(0, side, math.ceil(side / cell) + 1, dtype=dtype) for side in size
    )
    share = jnp.linspace(0, 1, DEEP + 1, dtype=dtype)

    def displacement_at(position):
        ray, _ = field_ray_through(bound.metadata, camera, position)

        def corner(share):
            distance = ray.near + (ray.far - ray.near) * share
            point = rays.point_at(ray.origin, ray.direction, distance)
            return displacement(bound, point, condition)

        return jax.vmap(corner)(share)

    # Row by row, with some thousand points at a time.
    return jax.lax.map(
        jax.vmap(displacement_at), jnp.stack(jnp.meshgrid(columns, rows), axis=-1)
    )


def column(
    grid: Grid, position: Float[Array, "2"], size: tuple[int, int]
) -> Float[Array, "corners 3"]:
    """Interpolate the grid along the ray through one pixel position.

    Args:
      grid: Displacements.
      position: Pixel position (x, y), [2].
      size: Width and height of the image in pixels.

    Returns:
      Displacements along the ray, [corners, 3].
    """
    rows, columns, *_ = grid.shape
    across, right = _between(position[0] * ((columns - 1) / size[0]), columns)
    down, below = _between(position[1] * ((rows - 1) / size[1]), rows)
    upper = _mix(grid[down, across], grid[down, across + 1], right)
    lower = _mix(grid[down + 1, across], grid[down + 1, across + 1], right)
    return _mix(upper, lower, below)


def along(
    column: Float[Array, "corners 3"], ray: Ray, distance: Float[Array, " samples"]
) -> Float[Array, "samples 3"]:
    """Interpolate displacements at distances along a ray, clamped to its ends.

    Args:
      column: Displacements along the ray, [corners, 3].
      ray: The ray. If its far equals its near, the displacement is the same everywhere.
      distance: Distances, [samples].

    Returns:
      Displacements, [samples, 3].
    """
    length = ray.far - ray.near
    share = (distance - ray.near) / jnp.where(length > 0, length, 1)
    corners = column.shape[0]
    before, past = _between(jnp.clip(share, 0, 1) * (corners - 1), corners)
    return _mix(column[before], column[before + 1], past[:, None])


def _between(place, corners):
    """Return the corner before a position, and the fraction to the next one."""
    before = jnp.clip(jnp.floor(place), 0, corners - 2)
    return before.astype(jnp.int32), place - before


def _mix(one, other, share):
    return one + share * (other - one)
