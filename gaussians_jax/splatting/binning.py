"""Binning of Gaussians to tiles in depth order, one chunk of pairs at a time.

All (Gaussian, tile) pairs form one conceptual list, nearest Gaussian first, its tiles
row by row. A chunk is the next `capacity` entries of that list, sorted by tile. Each
tile therefore meets its Gaussians in depth order for any capacity, and a Gaussian wider
than a chunk continues in the next one. Nothing can overflow.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.geometry.precision import exact_product

# Slack on the exact ellipse/tile test: it drops only what stays below the cut when the
# exponent is rounded differently in the blending step.
EXPONENT_SLACK = 1e-4


class Grid(NamedTuple):
    """Static division of the image into square tiles."""

    width: int  # px
    height: int
    tile: int

    @property
    def rows(self) -> int:
        return -(-self.height // self.tile)

    @property
    def columns(self) -> int:
        return -(-self.width // self.tile)

    @property
    def tiles(self) -> int:
        return self.rows * self.columns


class TileRects(NamedTuple):
    """Tiles that the rectangle of each Gaussian covers, nearest Gaussian first."""

    left: Int[Array, " gaussians"]
    top: Int[Array, " gaussians"]
    columns: Int[Array, " gaussians"]
    tiles: Int[Array, " gaussians"]  # columns times rows, zero if not rendered


class Cursor(NamedTuple):
    """Start of the next chunk in the list of pairs."""

    rank: Int[Array, ""]  # Gaussian, in depth order
    skip: Int[Array, ""]  # its tiles that earlier chunks have already taken


class Intersections(NamedTuple):
    """Pairs sorted by tile, then by depth."""

    ranks: Int[Array, " capacity"]
    starts: Int[Array, " tiles"]
    ends: Int[Array, " tiles"]


def tile_rects(
    mean_px: Float[Array, "gaussians 2"],
    extent_px: Float[Array, "gaussians 2"],
    grid: Grid,
) -> TileRects:
    """Find the tiles with a pixel center inside mean +- extent.

    Args:
      mean_px: Projected means in pixels.
      extent_px: Half sizes of the rectangles in pixels; 0 excludes a Gaussian.
      grid: The tiles.

    Returns:
      The rectangle of tiles of each Gaussian.
    """
    eps = jnp.finfo(mean_px.dtype).eps
    # Rounding of mean +- extent, so that a pixel on the edge is never lost.
    reach = extent_px + 8 * eps * (jnp.abs(mean_px) + extent_px)
    limit = jnp.asarray([grid.columns, grid.rows], mean_px.dtype)
    # Tile t covers pixel centers t * tile + 0.5 ... (t + 1) * tile - 0.5.
    low = jnp.ceil((mean_px - reach + 0.5) / grid.tile) - 1
    high = jnp.floor((mean_px + reach - 0.5) / grid.tile) + 1
    low = jnp.clip(low, 0, limit).astype(jnp.int32)
    high = jnp.clip(high, 0, limit).astype(jnp.int32)
    spans = jnp.maximum(high - low, 0)
    count = jnp.where(extent_px[:, 0] > 0, spans[:, 0] * spans[:, 1], 0)
    return TileRects(low[:, 0], low[:, 1], jnp.maximum(spans[:, 0], 1), count)


def depth_order(
    depth: Float[Array, " gaussians"], count: Int[Array, " gaussians"]
) -> Int[Array, " gaussians"]:
    """Indices from near to far, ties by index, Gaussians that touch no tile last."""
    if depth.dtype != jnp.float32:
        key = jnp.where(count > 0, depth, jnp.inf)
        return jnp.argsort(key, stable=True).astype(jnp.int32)
    # Radix passes over the depth's bits, each one sort of (some bits, position), as
    # many as the scene's range of depths needs, typically two: on the CPU this takes a
    # fifth of an argsort (262,144 rows: 12 for 63 ms).
    gaussians = depth.shape[0]
    position_bits = max(1, math.ceil(math.log2(gaussians)))
    digit_bits = 32 - position_bits
    position = jnp.arange(gaussians, dtype=jnp.uint32)
    bits = _ordered_bits(depth)
    drawn = count > 0
    nearest = jnp.min(jnp.where(drawn, bits, jnp.uint32(0xFFFFFFFF)))
    beyond = jnp.max(jnp.where(drawn, bits - nearest, 0)) + 1
    bits = jnp.where(drawn, bits - nearest, beyond)

    def one_pass(carry):
        number, order = carry
        shift = number * digit_bits
        key = (bits[order] >> shift << position_bits) | position
        more = 32 - lax.clz(beyond >> shift).astype(jnp.int32)  # bits that differ
        key = _sorted_by_upper_bits(key, position_bits, jnp.minimum(more, digit_bits))
        return number + 1, order[key & jnp.uint32((1 << position_bits) - 1)]

    def unsorted(carry):
        shift = carry[0] * digit_bits
        return (shift < 32) & ((beyond >> jnp.minimum(shift, 31)) > 0)

    start = (jnp.uint32(0), jnp.arange(gaussians, dtype=jnp.int32))
    return lax.while_loop(unsorted, one_pass, start)[1]


def _ordered_bits(depth):
    """The bits of float32 as unsigned integers in the same order."""
    bits = lax.bitcast_convert_type(depth, jnp.uint32)
    sign = jnp.uint32(0x80000000)
    return jnp.where(bits >= sign, ~bits, bits | sign)


def next_intersections(
    cursor: Cursor,
    rects: TileRects,
    table: Float[Array, "rows columns"],
    open_tiles: Bool[Array, " tiles"],
    log_cut: float,
    grid: Grid,
    capacity: int,
) -> tuple[Intersections, Cursor]:
    """Sort the next chunk of pairs by tile.

    Pairs of saturated tiles and pairs whose ellipse misses the tile are left out.

    Args:
      cursor: Start of the chunk.
      rects: Rectangles of tiles, in depth order.
      table: Its first six columns are the mean (px), p, k, r and log opacity of each
        Gaussian, in depth order.
      open_tiles: False for tiles whose pixels are all saturated.
      log_cut: Logarithm of the smallest alpha that is rendered.
      grid: The tiles.
      capacity: Number of pairs in a chunk.

    Returns:
      The pairs of the chunk, and the start of the following chunk.
    """
    rank, within, following = _expand(cursor, rects.tiles, capacity)
    in_use = rank >= 0
    rank = jnp.maximum(rank, 0)
    rect_columns = rects.columns[rank]
    row = rects.top[rank] + within // rect_columns
    column = rects.left[rank] + within % rect_columns
    tile = row * grid.columns + column
    # A column at a time, contiguous for the test: 65,536 pairs take 2.1 ms in all, and
    # 3.0 where rows are gathered.
    shape = [values[rank] for values in table[:, :6].T]
    keep = in_use & _ellipse_meets_tile(shape, row, column, log_cut, grid)
    keep &= open_tiles[jnp.where(in_use, tile, 0)]
    tile = jnp.where(keep, tile, grid.tiles)
    return sort_pairs(tile, rank, cursor.rank, rects.tiles.shape[0], grid), following


def advance(cursor: Cursor, count: Int[Array, " gaussians"], capacity: int) -> Cursor:
    """Compute the start of the next chunk.

    Args:
      cursor: Start of this chunk.
      count: Number of tiles of each Gaussian (`TileRects.tiles`).
      capacity: Number of pairs in a chunk.

    Returns:
      The start of the next chunk.
    """
    return _span(cursor, count, capacity)[2]


def _span(cursor, count, capacity):
    """First slot of each Gaussian (`capacity` if none), slots filled, what follows."""
    gaussians = count.shape[0]
    index = jnp.arange(gaussians, dtype=jnp.int32)
    count = jnp.where(index < cursor.rank, 0, count)
    count = count - jnp.where(index == cursor.rank, cursor.skip, 0)
    # int32 sums may wrap far behind the chunk, never before its end: the first total
    # beyond the capacity is at most capacity + tiles. So only what precedes the first
    # crossing is read.
    total = lax.cumsum(count)
    crossing = jnp.argmax(total >= capacity).astype(jnp.int32)
    full = total[crossing] >= capacity
    last = jnp.where(full, crossing, gaussians - 1)
    before = total - count
    begin = jnp.where((index <= last) & (count > 0), before, capacity)
    skip = capacity - before[last]
    skip += jnp.where(last == cursor.rank, cursor.skip, 0)
    partly = total[last] > capacity
    following = Cursor(
        jnp.where(full, last + jnp.where(partly, 0, 1), gaussians),
        jnp.where(full & partly, skip, 0),
    )
    return begin, jnp.minimum(total[last], capacity), following


def _expand(cursor, count, capacity):
    """Return each slot's rank and number within its rectangle, or -1 beyond the end."""
    begin, filled, following = _span(cursor, count, capacity)
    index = jnp.arange(count.shape[0], dtype=jnp.int32)
    marks = jnp.zeros(capacity + 1, jnp.int32).at[begin].max(index + 1)
    rank = _running_max(marks[:capacity]) - 1
    slot = jnp.arange(capacity, dtype=jnp.int32)
    within = slot - begin[jnp.maximum(rank, 0)]
    within += jnp.where(rank == cursor.rank, cursor.skip, 0)
    return jnp.where(slot < filled, rank, -1), within, following


def _running_max(marks):
    """The largest of `marks`, none of them negative, up to each.

    65,536 of them in 0.26 ms on the CPU, in 0.18 by `lax.associative_scan`: that takes
    0.6 s to compile for 0.2, twice in each step. `lax.cummax` of all: four times as
    long.
    """
    size = marks.shape[0]
    block = jnp.pad(marks, (0, -size % 16)).reshape(-1, 16)
    before = lax.cummax(jnp.max(block, axis=1))
    block = block.at[1:, 0].max(before[:-1])
    for step in (1, 2, 4, 8):
        block = jnp.maximum(block, jnp.pad(block[:, :-step], ((0, 0), (step, 0))))
    return block.reshape(-1)[:size]


def _ellipse_meets_tile(shape, row, column, log_cut, grid):
    """Test if the smallest exponent over the tile's pixel centers reaches the cut.

    The minimum of a convex form over a rectangle is zero inside, or lies on an edge
    that faces the center. The lines x = clip(mean x) and y = clip(mean y) contain it in
    every case.
    """
    mean_x, mean_y, p, k, r, log_opacity = shape
    half = (grid.tile - 1) / 2
    dx = (column * grid.tile).astype(p.dtype) + (half + 0.5) - mean_x
    dy = (row * grid.tile).astype(p.dtype) + (half + 0.5) - mean_y
    rk = r * k
    u0, v0 = p * dx, r * (dy - k * dx)
    x = jnp.clip(-dx, -half, half)
    v = v0 - rk * x
    y = jnp.clip(-v / r, -half, half)
    on_column = (u0 + p * x) ** 2 + (v + r * y) ** 2
    y = jnp.clip(-dy, -half, half)
    v = v0 + r * y
    x = jnp.clip((rk * v - p * u0) / (p * p + rk * rk), -half, half)
    on_row = (u0 + p * x) ** 2 + (v - rk * x) ** 2
    smallest = jnp.minimum(on_column, on_row)
    return smallest <= log_opacity - log_cut + EXPONENT_SLACK


def sort_pairs(
    tile: Int[Array, " capacity"],
    rank: Int[Array, " capacity"],
    first_rank: Int[Array, ""],
    gaussians: int,
    grid: Grid,
) -> Intersections:
    """Sort pairs, given in depth order, by tile.

    One unsigned sort of (tile, rank since the chunk's first) is used where both fit 32
    bits. A sort with a payload costs ten times as much on the CPU.

    Args:
      tile: Tile of each slot; `grid.tiles` marks an unused slot.
      rank: Depth rank of the Gaussian in each slot.
      first_rank: Smallest rank of the chunk.
      gaussians: Number of Gaussians.
      grid: The tiles.

    Returns:
      The sorted pairs.
    """
    capacity = tile.shape[0]
    # Only Gaussians that touch no tile, and these come last, have no pair: so ranks
    # within a chunk span less than its capacity.
    rank_bits = max(1, (min(capacity, gaussians) - 1).bit_length())
    tile_bits = grid.tiles.bit_length()
    if rank_bits + tile_bits <= 32:
        since = (rank - first_rank).astype(jnp.uint32)
        since = jnp.where(tile < grid.tiles, since, 0)
        key = (tile.astype(jnp.uint32) << rank_bits) | since
        key = _sorted_by_upper_bits(key, rank_bits, tile_bits)
        tile = (key >> rank_bits).astype(jnp.int32)
        ranks = (key & jnp.uint32((1 << rank_bits) - 1)).astype(jnp.int32) + first_rank
    else:
        # Slots are in depth order already, so a stable sort by tile is enough.
        tile, ranks = lax.sort((tile, rank), num_keys=1, is_stable=True)
    bounds = jnp.searchsorted(tile, jnp.arange(grid.tiles + 1, dtype=jnp.int32))
    bounds = bounds.astype(jnp.int32)
    return Intersections(ranks, bounds[:-1], bounds[1:])


def longest_first(length: Int[Array, " tiles"]) -> Int[Array, " tiles"]:
    """Order the tiles from most to fewest pairs.

    Ties go to the lower number, and empty tiles come last. Tile and length share a word
    of 32 bits, so lengths that do not fit count as ties.

    Args:
      length: Number of pairs of each tile.

    Returns:
      Tile numbers.
    """
    tile_bits = max(1, (length.shape[0] - 1).bit_length())
    most = jnp.minimum(jnp.max(length), (1 << (32 - tile_bits)) - 1)
    fewer = (most - jnp.minimum(length, most)).astype(jnp.uint32)
    key = (fewer << tile_bits) | jnp.arange(length.shape[0], dtype=jnp.uint32)
    key = _sorted_by_upper_bits(key, tile_bits, 32 - lax.clz(most))
    return (key & jnp.uint32((1 << tile_bits) - 1)).astype(jnp.int32)


def _sorted_by_upper_bits(key, lowest, bits):
    """Words in the order of their `bits` from bit `lowest` on, ties as they came.

    The bits below must rise among ties already, so that elsewhere than on a CPU whole
    words are sorted. Here it is a radix sort, three bits a pass: a word goes behind
    those of smaller digits, the equal ones in earlier blocks of eight words, and the
    equal ones before it in its own. The last are counted in one word, a hexadecimal
    digit for each of eight.
    """
    if jax.default_backend() != "cpu":
        return lax.sort(key)
    size = key.shape[0]
    key = jnp.concatenate([key, jnp.full(-size % 8, 0xFFFFFFFF, key.dtype)])
    digits = jnp.arange(8, dtype=jnp.uint32)
    up_to = jnp.triu(jnp.ones((8, 8), jnp.uint32))
    block = jnp.arange(key.shape[0] // 8, dtype=jnp.uint32)[:, None]

    def one_pass(number, key):
        shift = (lowest + 3 * number).astype(jnp.uint32)
        digit = (key.reshape(-1, 8) >> shift) & 7
        one = jnp.uint32(1) << (4 * digit)
        # Whole words: under a default of products in bfloat16 it would cast them.
        tally = exact_product(one, up_to)
        counts = (tally[:, 7:] >> (4 * digits)) & 15
        total, before = lax.scan(lambda c, x: (c + x, c), 0 * digits, counts)
        before += lax.cumsum(total) - total
        place = before.reshape(-1).at[8 * block + digit].get(mode="promise_in_bounds")
        place += ((tally - one) >> (4 * digit)) & 15
        return key.at[place.reshape(-1)].set(
            key, mode="promise_in_bounds", unique_indices=True
        )

    return lax.fori_loop(0, (bits + 2) // 3, one_pass, key)[:size]
