"""What warps say, asked on a grid in the frustum of one frame and read between.

A frame has millions of samples, and a warp is a network that is smooth in space: it is
asked at the corners of a grid whose lines are rays of the picture, and interpolated
straight in column, row and share of the depth. Without a lens' distortion a
displacement that is linear in space comes back as it is.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.field_ray import Ray, field_ray_through
from nerfies_jax.geometry import rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.render_ray import Bound, displacement
from nerfies_jax.training.effects import FrameCondition

# Cells along the longer side of the picture, and in depth. Frames of 256x192 beside the
# full quadrature, and milliseconds of one core of a 2.5 GHz Xeon:
#   `d-nerf-grid-small`, built-in scene, 400 steps, every sample   72 to 74 dB in 1,640
#     32 across, 64 deep                                           50 to 51        870
#     48 and 64                                                    54 to 55        930
#     64 and 64                                                    56 to 57      1,000
#     64 and 128                                                   59 to 60      1,100
#   `nerfies-grid-small`, bookshelf, 300 steps, every sample     100 to 111      1,760
#     48 and 64                                                    60 to 69        980
# The survey and the template alone take some 800. With HyperNeRF's slices on the grid,
# of 7 cells a wave, 41 dB; asked of each sample they take what the warp saves.
ACROSS, DEEP = 48, 64
CELLS_A_WAVE = 16  # fewer of the shortest wave, and every sample asks

Grid = Float[Array, "rows columns corners 3"]


def resolves(bound: Bound) -> bool:
    """Whether warps are all that moves a field, of waves that are long beside cells.

    Not with lifts or marks: what else a sample is asked of every point takes as long.
    An effect says its shortest wave (`Effect.shortest_wave`), or nothing is known.
    """
    metadata = bound.metadata
    cell = (metadata.far - metadata.near) * metadata.scale / DEEP
    if any((effect.lift, effect.mark) != (None, None) for effect in bound.effects):
        return False
    waves = [e.shortest_wave for e in bound.effects if e.displace is not None]
    if not waves or None in waves:
        return False
    return CELLS_A_WAVE * cell <= min(waves)


def displacements(
    bound: Bound, camera: Camera, condition: FrameCondition, size: tuple[int, int]
) -> Grid:
    """Template point minus observed point at all corners between near and far; pure."""
    cell = max(*size, ACROSS) / ACROSS  # a pixel or more
    dtype = camera.position.dtype
    columns, rows = (
        jnp.linspace(0, side, math.ceil(side / cell) + 1, dtype=dtype) for side in size
    )
    share = jnp.linspace(0, 1, DEEP + 1, dtype=dtype)

    def moved(position):
        ray, _ = field_ray_through(bound.metadata, camera, position)

        def corner(share):
            distance = ray.near + (ray.far - ray.near) * share
            point = rays.point_at(ray.origin, ray.direction, distance)
            return displacement(bound, point, condition)

        return jax.vmap(corner)(share)

    # Row by row: some thousand points at once.
    return jax.lax.map(jax.vmap(moved), jnp.stack(jnp.meshgrid(columns, rows), axis=-1))


def column(
    grid: Grid, position: Float[Array, "2"], size: tuple[int, int]
) -> Float[Array, "corners 3"]:
    """The grid along the ray through one pixel position."""
    rows, columns, *_ = grid.shape
    across, right = _between(position[0] * ((columns - 1) / size[0]), columns)
    down, below = _between(position[1] * ((rows - 1) / size[1]), rows)
    upper = _mixed(grid[down, across], grid[down, across + 1], right)
    lower = _mixed(grid[down + 1, across], grid[down + 1, across + 1], right)
    return _mixed(upper, lower, below)


def along(
    column: Float[Array, "corners 3"], ray: Ray, distance: Float[Array, " samples"]
) -> Float[Array, "samples 3"]:
    """Displacements at distances along a ray, before near and beyond far of its ends.

    A ray whose far is its near has one for all.
    """
    length = ray.far - ray.near
    share = (distance - ray.near) / jnp.where(length > 0, length, 1)
    corners = column.shape[0]
    before, past = _between(jnp.clip(share, 0, 1) * (corners - 1), corners)
    return _mixed(column[before], column[before + 1], past[:, None])


def _between(place, corners):
    """The corner before a place, and how far beyond it the place is."""
    before = jnp.clip(jnp.floor(place), 0, corners - 2)
    return before.astype(jnp.int32), place - before


def _mixed(one, other, share):
    return one + share * (other - one)
