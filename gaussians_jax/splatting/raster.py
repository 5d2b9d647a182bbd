"""Exact, differentiable tile rasterizer with memory independent of the number of pairs.

Front-to-back compositing over square tiles (Kerbl et al. 2023, arXiv:2308.04079,
equation 3), streamed over chunks in depth order (`binning`), with a hand-written
backward pass that recomputes every alpha (`blending`).

By default XLA:CPU splits every small operation of the loops over all cores, which costs
twice the CPU time and 1.0 to 1.9 times the wall time. A `Model` of Gaussians is
compiled without that. Compile your own functions with `jax.jit(function,
compiler_options=UNDIVIDED)` (`nerfies_jax.runtime.compiler`). To use several cores,
render several views at once, each on one CPU device
(`nerfies_jax.runtime.data_parallel`).
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from gaussians_jax.core.splats import refuse_half
from gaussians_jax.splatting import binning, blending
from gaussians_jax.splatting.binning import Cursor, Grid, Intersections
from gaussians_jax.splatting.blending import SHAPE_COLUMNS, Lockstep
from gaussians_jax.splatting.projection import Footprints
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax.geometry.linear_call import linear_call
from nerfies_jax.runtime.contract import checked

# Tiles and Gaussians per iteration, by backend. On a CPU 32 x 4 x 64 evaluations hide
# XLA's overhead of about 0.2 us per operation and stay in the cache. On a GPU, where
# each operation is a launch, all tiles run at once (not measured yet).
LOCKSTEP = {"cpu": Lockstep(32, 4), "gpu": Lockstep(4096, 8)}
SMALLEST_CAPACITY = 1 << 12
LARGEST_CAPACITY = 1 << 19
LEAST_PACKED_CAPACITY = 1 << 17
PAIRS_PER_GAUSSIAN = 4
PAIRS_PER_TILE = 64


class Layout(NamedTuple):
    """Static settings of one call."""

    spec: RasterSpec
    grid: Grid
    step: Lockstep
    capacity: int


class Residuals(NamedTuple):
    """Chunks sorted in the forward pass, for the backward pass."""

    chunks: Intersections  # leading axis: the first `kept_chunks` chunks
    chunk_count: Int[Array, ""]  # number of chunks in the forward pass


@checked
def rasterize(
    footprints: Footprints,
    values: Float[Array, "gaussians channels"],
    size: tuple[int, int],
    spec: RasterSpec,
) -> tuple[Float[Array, "height width channels"], Float[Array, "height width"]]:
    """Composite per-Gaussian values front to back.

    The function is differentiable with respect to the mean, whitening and opacity of
    `footprints` and to `values`: in reverse mode, in forward mode, and forward over
    reverse (Hessian-vector products). A second reverse mode is not available. Depth is
    only used for the order. The image is discontinuous where alpha crosses
    `spec.alpha_threshold` and where a pixel is saturated
    (`spec.transmittance_threshold`), and its gradient is discontinuous at
    `spec.alpha_max`. Derivatives are those between the discontinuities.

    Args:
      footprints: N projected Gaussians.
      values: Any number of channels per Gaussian, [N, channels]. A NaN appears in every
        tile that its Gaussian overlaps.
      size: (width, height) of the image in pixels.
      spec: Thresholds and tile sizes.

    Returns:
      The image [height, width, channels] and the remaining transmittance of each pixel
      [height, width].

    Raises:
      ValueError: If the image has no pixels, or `values` has no channels.
    """
    layout = _layout(footprints, size, spec)
    grid = layout.grid
    if values.shape[1] == 0:
        raise ValueError("values need at least one channel, got shape [gaussians, 0]")
    if values.shape[0] == 0:
        shape = (grid.height, grid.width)
        blank = jnp.zeros((*shape, values.shape[1]), values.dtype)
        return blank, jnp.ones(shape, values.dtype)
    rects, table, _ = _in_depth_order(footprints, values, grid)
    state = _raster(layout, rects, table)
    return _to_image(state[:, 1:], grid), _to_image(state[:, :1], grid)[..., 0]


@checked
def summed_weights(
    footprints: Footprints, size: tuple[int, int], spec: RasterSpec
) -> Float[Array, " gaussians"]:
    """Sum the compositing weights of each Gaussian over all pixels.

    The sum is the gradient of the sum of all pixels with respect to the value of the
    Gaussian. The pass of the gradient alone computes it, without an image.

    Args:
      footprints: N projected Gaussians, at least one.
      size: (width, height) of the image in pixels.
      spec: Thresholds and tile sizes.

    Returns:
      The sums, in pixels.
    """
    layout = _layout(footprints, size, spec)
    grid, dtype = layout.grid, footprints.mean_px.dtype
    values = jnp.zeros((len(footprints.depth), 1), dtype)
    rects, table, order = _in_depth_order(footprints, values, grid)
    ones = _to_tiles(jnp.ones((grid.height, grid.width, 1), dtype), grid)
    rows = _with_transparent_row(table)

    def body(carry):
        cursor, state, gradient = carry
        isects, cursor = _next_intersections(layout, cursor, rects, table, state)
        state, gradient = blending.blend_gradient(
            state, gradient, isects, rows, ones, spec, grid, layout.step
        )
        return cursor, state, gradient

    start = (
        Cursor(jnp.int32(0), jnp.int32(0)),
        _blank(layout, 1, dtype),
        jnp.zeros_like(rows),
    )
    *_, gradient = lax.while_loop(
        lambda carry: _has_more(carry[0], carry[1], rects), body, start
    )
    return jnp.zeros(len(order), dtype).at[order].set(gradient[:-1, SHAPE_COLUMNS])


def _in_depth_order(footprints, values, grid):
    """Sort the tile rectangles and the table by depth, and return the order."""
    rects = binning.tile_rects(
        lax.stop_gradient(footprints.mean_px), footprints.extent_px, grid
    )
    order = binning.depth_order(lax.stop_gradient(footprints.depth), rects.tiles)
    rects = binning.TileRects(*(x[order] for x in rects))
    log_opacity = jnp.log(jnp.where(rects.tiles > 0, footprints.opacity[order], 1))
    table = [
        footprints.mean_px[order],
        footprints.whitening[order],
        log_opacity[:, None],
        values[order],
    ]
    return rects, jnp.concatenate(table, axis=1), order


def _layout(footprints, size, spec):
    refuse_half(footprints.mean_px.dtype)
    if min(size) < 1:
        raise ValueError(
            f"an image needs at least one pixel, got size {size} (width, height)"
        )
    grid = Grid(*size, spec.tile)
    step = LOCKSTEP.get(jax.default_backend(), LOCKSTEP["gpu"])
    step = Lockstep(spec.batch or step.batch, spec.chunk or step.chunk)
    step = Lockstep(min(step.batch, grid.tiles), step.chunk)
    capacity = spec.capacity
    if capacity is None:
        gaussians = footprints.depth.shape[0]
        # Few Gaussians cover many tiles of a large image. A step of 1,500 at 1280x720
        # takes 1.30 s with pairs for the Gaussians only, 0.44 s with 16 for each tile,
        # and 0.42 s with 64; one of 10,000 at 704x528 0.75, 0.66 and 0.57 s (one core).
        pairs = max(PAIRS_PER_GAUSSIAN * gaussians, PAIRS_PER_TILE * grid.tiles)
        capacity = min(max(pairs, SMALLEST_CAPACITY), LARGEST_CAPACITY)
        capacity = 1 << math.ceil(math.log2(capacity))
        # Tile and rank fit into one 32-bit word, because a sort of two arrays takes ten
        # times as long. Chunks have a minimum size, because each also passes over all
        # tiles: 200,000 Gaussians at 800x800 take 0.93 of the time in two chunks
        # instead of four.
        packed_capacity = 1 << (32 - grid.tiles.bit_length())
        if gaussians > packed_capacity >= LEAST_PACKED_CAPACITY:
            capacity = min(capacity, packed_capacity)
    return Layout(spec, grid, step, capacity)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _raster(layout, rects, table):
    """Return the state [tiles, 1 + channels, pixels]: transmittance, then channels."""
    return _without_marks(_forward(layout, rects, table)[0])


@_raster.defjvp
def _raster_jvp(layout, primals, tangents):
    rects, table = primals
    state, residuals = _forward(layout, rects, table)
    residuals = rects, table, state, residuals
    tangent = linear_call(_tangent, _cotangent, layout, residuals, tangents[1])
    return _without_marks(state), tangent


# Cameras run one after another under vmap, because lockstep would wait for all of them.
def _forward(layout, rects, table):
    @jax.custom_batching.sequential_vmap
    def forward(rects, table):
        return _stream(layout, rects, table)

    return forward(rects, table)


def _tangent(layout, residuals, tangent):
    """Compute the tangent of the image by a second forward pass."""
    through = layout.spec.clamp_gradient == "through"

    @jax.custom_batching.sequential_vmap
    def jvp(rects, table, tangent):
        def image_of(table):
            return _without_marks(_stream(layout, rects, table, through)[0])

        return jax.jvp(image_of, (table,), (tangent,))[1]

    rects, table, *_ = residuals
    return jvp(rects, table, tangent)


def _cotangent(layout, residuals, cotangent):
    """Compute the gradient of the table from that of the image."""

    @jax.custom_batching.sequential_vmap
    def backward(rects, table, state, residuals, cotangent):
        return _stream_back(layout, rects, table, state, residuals, cotangent)

    return backward(*residuals, cotangent)


def _without_marks(state):
    # Only the sign of the transmittance marks saturation. Channels may be negative.
    return jnp.concatenate([jnp.abs(state[:, :1]), state[:, 1:]], axis=1)


def _with_transparent_row(table):
    """Append a transparent Gaussian for the slots beyond a tile's last pair."""
    row = jnp.zeros((1, table.shape[1]), table.dtype)
    row = row.at[0, SHAPE_COLUMNS - 1].set(-jnp.inf)
    # p and r are one, because the gradient divides by them.
    row = row.at[0, 2].set(1).at[0, 4].set(1)
    return jnp.concatenate([table, row])


def _blank(layout, channels, dtype):
    """Return transmittance 1 inside the image and -1 (saturated) outside."""
    grid = layout.grid
    inside = jnp.full((grid.height, grid.width, 1), 1, dtype)
    transmittance = _to_tiles(inside, grid) * 2 - 1
    zeros = jnp.zeros((grid.tiles, channels, grid.tile**2), dtype)
    return jnp.concatenate([transmittance, zeros], axis=1)


def _next_intersections(layout, cursor, rects, table, state):
    open_tiles = jnp.max(state[:, 0], axis=1) > 0
    log_cut = math.log(layout.spec.alpha_threshold)
    return binning.next_intersections(
        cursor, rects, table, open_tiles, log_cut, layout.grid, layout.capacity
    )


def _has_more(cursor, state, rects):
    rendered_count = jnp.sum(rects.tiles > 0, dtype=jnp.int32)
    return (cursor.rank < rendered_count) & (jnp.max(state[:, 0]) > 0)


def _stream(layout, rects, table, through=False):
    """Composite all chunks. With `through`, derivatives ignore the clamp of alpha."""
    channels = table.shape[1] - SHAPE_COLUMNS
    rows = _with_transparent_row(table)
    spec, grid, step = layout.spec, layout.grid, layout.step

    def body(carry):
        cursor, state, residuals = carry
        isects, cursor = _next_intersections(layout, cursor, rects, table, state)
        state, used_count = blending.blend(
            state, isects, rows, spec, grid, step, through
        )
        # The backward pass skips the pairs that early stopping skipped.
        isects = isects._replace(ends=isects.starts + used_count)
        chunks = jax.tree.map(
            lambda all_, chunk: all_.at[residuals.chunk_count].set(chunk, mode="drop"),
            residuals.chunks,
            isects,
        )
        return (
            cursor,
            state,
            Residuals(chunks, residuals.chunk_count + 1),
        )

    keep = spec.kept_chunks
    chunks = Intersections(
        jnp.zeros((keep, layout.capacity), jnp.int32),
        jnp.zeros((keep, grid.tiles), jnp.int32),
        jnp.zeros((keep, grid.tiles), jnp.int32),
    )
    start = (
        Cursor(jnp.int32(0), jnp.int32(0)),
        _blank(layout, channels, table.dtype),
        Residuals(chunks, jnp.int32(0)),
    )
    _, state, residuals = lax.while_loop(
        lambda carry: _has_more(carry[0], carry[1], rects), body, start
    )
    return state, residuals


def _stream_back(layout, rects, table, final, residuals, cotangent):
    """Backpropagate through the same chunks, sorting those that were not kept."""
    rows = _with_transparent_row(table)
    spec, grid, step = layout.spec, layout.grid, layout.step
    channel_gradient = cotangent[:, 1:]
    remaining = jnp.abs(final[:, 0]) * cotangent[:, 0]
    for c in range(channel_gradient.shape[1]):
        remaining += final[:, 1 + c] * channel_gradient[:, c]
    blank = _blank(layout, 0, table.dtype)
    state = jnp.concatenate([blank, remaining[:, None]], axis=1)
    keep = spec.kept_chunks

    def body(carry):
        number, cursor, state, gradient = carry
        isects, cursor = lax.cond(
            number < keep,
            lambda: _kept_intersections(layout, residuals, number, cursor, rects),
            lambda: _next_intersections(layout, cursor, rects, table, state),
        )
        state, gradient = blending.blend_gradient(
            state, gradient, isects, rows, channel_gradient, spec, grid, step
        )
        return number + 1, cursor, state, gradient

    start = (
        jnp.int32(0),
        Cursor(jnp.int32(0), jnp.int32(0)),
        state,
        jnp.zeros_like(rows),
    )
    *_, gradient = lax.while_loop(
        lambda carry: carry[0] < residuals.chunk_count, body, start
    )
    return gradient[:-1]


def _kept_intersections(layout, residuals, number, cursor, rects):
    isects = jax.tree.map(lambda x: x[number], residuals.chunks)
    return isects, binning.advance(cursor, rects.tiles, layout.capacity)


def _to_tiles(image, grid):
    """Reshape [height, width, c] to [tiles, c, pixels], zero outside the image."""
    height, width = grid.rows * grid.tile, grid.columns * grid.tile
    image = jnp.pad(image, ((0, height - grid.height), (0, width - grid.width), (0, 0)))
    image = image.reshape(grid.rows, grid.tile, grid.columns, grid.tile, -1)
    return image.transpose(0, 2, 4, 1, 3).reshape(grid.tiles, -1, grid.tile**2)


def _to_image(tiles, grid):
    """Reshape [tiles, c, pixels] to [height, width, c]."""
    tiles = tiles.reshape(grid.rows, grid.columns, -1, grid.tile, grid.tile)
    image = tiles.transpose(0, 3, 1, 4, 2)
    image = image.reshape(grid.rows * grid.tile, grid.columns * grid.tile, -1)
    return image[: grid.height, : grid.width]
