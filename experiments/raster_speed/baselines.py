"""Two plain ways to rasterize the same footprints, for comparison: autodiff throughout.

`dense` evaluates every Gaussian at every pixel; `lockstep` scans all tiles together
over their sorted lists. Both recompute blocks in the backward pass, or memory would end
them at a few thousand Gaussians.
"""

import math

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from gaussians_jax import binning
from gaussians_jax.binning import Cursor, Grid
from gaussians_jax.projection import Footprints
from gaussians_jax.raster_spec import RasterSpec

DENSE_PIXELS = 1024  # a block of the dense baseline


def _alphas(footprints, x, y, spec):
    """Alpha of rows of `footprints` at pixels; the last axis is the pixel's."""
    p, k, r = (footprints.whitening[..., i, None] for i in range(3))
    dx = x - footprints.mean_px[..., 0, None]
    dy = y - footprints.mean_px[..., 1, None]
    exponent = jnp.square(p * dx) + jnp.square(r * (dy - k * dx))
    raw = footprints.opacity[..., None] * jnp.exp(-exponent)
    return jnp.where(raw >= spec.alpha_threshold, jnp.minimum(raw, spec.alpha_max), 0)


def dense(
    footprints: Footprints,
    values: Float[Array, "gaussians channels"],
    size: tuple[int, int],
    spec: RasterSpec,
) -> tuple[Float[Array, "height width channels"], Float[Array, "height width"]]:
    """Every Gaussian at every pixel, in blocks of pixels, by cumulative products."""
    width, height = size
    order = jnp.argsort(footprints.depth)
    footprints = jax.tree.map(lambda leaf: leaf[order], footprints)
    values = values[order]

    @jax.checkpoint
    def block(pixels):
        alpha = _alphas(footprints, pixels[0] + 0.5, pixels[1] + 0.5, spec)
        passed = jnp.cumprod(1 - alpha, axis=0)
        before = jnp.concatenate([jnp.ones_like(passed[:1]), passed[:-1]])
        drawn = passed > spec.transmittance_threshold
        weight = jnp.where(drawn, alpha * before, 0)
        left = jnp.min(jnp.where(drawn, passed, 1), axis=0)
        return jnp.concatenate([weight.T @ values, left[:, None]], axis=1)

    blocks = -(-height * width // DENSE_PIXELS)
    pixel = jnp.arange(blocks * DENSE_PIXELS)
    pixels = jnp.stack([pixel % width, pixel // width]).astype(values.dtype)
    pixels = pixels.reshape(2, blocks, DENSE_PIXELS).transpose(1, 0, 2)
    picture = lax.map(block, pixels).reshape(-1, values.shape[1] + 1)
    picture = picture[: height * width].reshape(height, width, -1)
    return picture[..., :-1], picture[..., -1]


def lockstep(
    footprints: Footprints,
    values: Float[Array, "gaussians channels"],
    size: tuple[int, int],
    spec: RasterSpec,
    pairs: int,
    longest: int,
) -> tuple[Float[Array, "height width channels"], Float[Array, "height width"]]:
    """All tiles together, one Gaussian each a step, checkpointed by the square root.

    `pairs` and `longest` are the number of box pairs and of a tile's Gaussians: this
    form must know both beforehand.
    """
    grid = Grid(*size, spec.tile)
    fixed = jax.tree.map(lax.stop_gradient, footprints)
    rects = binning.tile_rects(fixed.mean_px, fixed.extent_px, grid)
    order = binning.depth_order(fixed.depth, rects.count)
    rects = binning.TileRects(*(x[order] for x in rects))
    log_opacity = jnp.log(jnp.where(rects.count > 0, fixed.opacity[order], 1))
    table = [fixed.mean_px[order], fixed.whitening[order], log_opacity[:, None]]
    isects, _ = binning.next_intersections(
        Cursor(jnp.int32(0), jnp.int32(0)),
        rects,
        jnp.concatenate(table, axis=1),
        jnp.ones(grid.tiles, bool),
        math.log(spec.alpha_threshold),
        grid,
        pairs,
    )
    tile = jnp.arange(grid.tiles)
    pixel = jnp.arange(grid.tile**2)
    x = (tile % grid.columns)[:, None] * grid.tile + pixel % grid.tile
    y = (tile // grid.columns)[:, None] * grid.tile + pixel // grid.tile
    x, y = x.astype(values.dtype) + 0.5, y.astype(values.dtype) + 0.5

    def step(state, number):
        transmittance, channels = state
        slot = isects.starts + number
        row = order[isects.ranks.at[slot].get(mode="clip")]
        here = jax.tree.map(lambda leaf: leaf[row], footprints)
        alpha = jnp.where((slot < isects.ends)[:, None], _alphas(here, x, y, spec), 0)
        passed = transmittance * (1 - alpha)
        drawn = passed > spec.transmittance_threshold
        weight = jnp.where(drawn, transmittance * alpha, 0)
        channels = channels + weight[:, None] * values[row][..., None]
        return (jnp.where(drawn, passed, -jnp.abs(transmittance)), channels), None

    inner = math.ceil(math.sqrt(longest))

    @jax.checkpoint
    def several(state, first):
        return lax.scan(step, state, first + jnp.arange(inner))

    state = (jnp.ones_like(x), jnp.zeros((grid.tiles, values.shape[1], grid.tile**2)))
    state, _ = lax.scan(several, state, jnp.arange(0, longest, inner))
    picture = jnp.concatenate([state[1], jnp.abs(state[0])[:, None]], axis=1)
    picture = picture.reshape(grid.rows, grid.columns, -1, grid.tile, grid.tile)
    picture = picture.transpose(0, 3, 1, 4, 2)
    picture = picture.reshape(grid.rows * grid.tile, grid.columns * grid.tile, -1)
    picture = picture[: grid.height, : grid.width]
    return picture[..., :-1], picture[..., -1]
