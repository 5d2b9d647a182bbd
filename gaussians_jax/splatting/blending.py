"""Front-to-back compositing of sorted pairs, and its gradient, with tiles in lockstep.

The state of a tile has one row of transmittance and one row per channel, with pixels as
last axis. The transmittance of a saturated pixel is stored as negative, so that no mask
is needed. Both passes go front to back and recompute all alphas.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from gaussians_jax.splatting.binning import Grid, Intersections, longest_first
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax.geometry.precision import exact_einsum, exact_product

SHAPE_COLUMNS = 6  # mean x, mean y (px), p, k, r, log opacity; then channels


class Lockstep(NamedTuple):
    """Static number of tiles and Gaussians that one loop iteration processes."""

    batch: int
    chunk: int


def blend(
    state: Float[Array, "tiles rows pixels"],
    isects: Intersections,
    table: Float[Array, "gaussians columns"],
    spec: RasterSpec,
    grid: Grid,
    step: Lockstep,
    through: bool = False,
) -> tuple[Float[Array, "tiles rows pixels"], Int[Array, " tiles"]]:
    """Composite a chunk of pairs onto the state.

    Args:
      state: Transmittance and channels of each tile.
      isects: Sorted pairs.
      table: Columns of each Gaussian. The last Gaussian must be transparent (log
        opacity minus infinity).
      spec: Thresholds.
      grid: The tiles.
      step: Numbers of tiles and Gaussians per iteration.
      through: Let forward-mode derivatives ignore the clamp of alpha.

    Returns:
      The new state, and the number of pairs that each tile evaluated.
    """
    order, batches = _by_length(isects, step.batch)

    def one_batch(carry):
        number, state, used_count = carry
        tiles = lax.dynamic_slice(order, (number * step.batch,), (step.batch,))
        start, end, center = _tile_rows(tiles, isects, grid, state.dtype)
        longest = jnp.max(end - start)

        def has_pairs(inner):
            position, *_, alive = inner
            return (position < longest) & alive

        def one_chunk(inner):
            position, transmittance, channels, _ = inner
            _, rows = _chunk(table, isects.ranks, start, end, position, step.chunk)
            raw, alpha = _alphas(rows, center, spec, grid)
            if through:
                alpha = _straight_through(raw, alpha)
            transmittance, channels = _composite(
                transmittance, channels, alpha, rows, spec
            )
            return (
                position + step.chunk,
                transmittance,
                channels,
                _any_open(transmittance),
            )

        def count(inner):
            return jnp.minimum(end - start, inner)

        transmittance, channels = _parts(state.at[tiles].get(mode="clip"))
        position, transmittance, channels, _ = lax.while_loop(
            has_pairs,
            one_chunk,
            (jnp.int32(0), transmittance, channels, _any_open(transmittance)),
        )
        local = jnp.stack([transmittance, *channels], axis=1)
        state = state.at[tiles].set(local, mode="drop")
        used_count = used_count.at[tiles].set(count(position), mode="drop")
        return number + 1, state, used_count

    used_count = jnp.zeros(grid.tiles, jnp.int32)
    _, state, used_count = lax.while_loop(
        lambda carry: carry[0] < batches, one_batch, (jnp.int32(0), state, used_count)
    )
    return state, used_count


def blend_gradient(
    state: Float[Array, "tiles rows pixels"],
    gradient: Float[Array, "gaussians columns"],
    isects: Intersections,
    table: Float[Array, "gaussians columns"],
    cotangent: Float[Array, "tiles channels pixels"],
    spec: RasterSpec,
    grid: Grid,
    step: Lockstep,
) -> tuple[Float[Array, "tiles rows pixels"], Float[Array, "gaussians columns"]]:
    """Add the gradient of a chunk to the gradient of the table.

    `state` has two rows: the transmittance, and the part S of the loss that depends on
    the remaining Gaussians of the pixel: the sum of w (color . g), plus g_T times the
    final transmittance. Going front to back,

        d loss / d alpha_i = T_i (color_i . g) - S_i / (1 - alpha_i),

    where S_i is the part behind Gaussian i. Only the final image is needed.

    Args:
      state: Transmittance and S of each tile.
      gradient: Gradient of the table so far.
      isects: Sorted pairs.
      table: Columns of each Gaussian, the last one transparent.
      cotangent: Gradient g of the loss with respect to the image.
      spec: Thresholds.
      grid: The tiles.
      step: Numbers of tiles and Gaussians per iteration.

    Returns:
      The new state and gradient.
    """
    order, batches = _by_length(isects, step.batch)

    def one_batch(carry):
        number, state, gradient = carry
        tiles = lax.dynamic_slice(order, (number * step.batch,), (step.batch,))
        start, end, center = _tile_rows(tiles, isects, grid, state.dtype)
        longest = jnp.max(end - start)
        pixel_gradient = cotangent.at[tiles].get(mode="clip")

        def has_pairs(inner):
            position, _, _, alive, _ = inner
            return (position < longest) & alive

        def one_chunk(inner):
            position, transmittance, remaining, _, gradient = inner
            rank, rows = _chunk(table, isects.ranks, start, end, position, step.chunk)
            raw, alpha = _alphas(rows, center, spec, grid)
            transmittance, remaining, weight, grad = _trace_back(
                transmittance, remaining, raw, alpha, rows, pixel_gradient, spec
            )
            update = _pair_gradients(rows, center, weight, grad, pixel_gradient, grid)
            gradient = gradient.at[rank].add(update)
            return (
                position + step.chunk,
                transmittance,
                remaining,
                _any_open(transmittance),
                gradient,
            )

        transmittance, (remaining,) = _parts(state.at[tiles].get(mode="clip"))
        _, transmittance, remaining, _, gradient = lax.while_loop(
            has_pairs,
            one_chunk,
            (
                jnp.int32(0),
                transmittance,
                remaining,
                _any_open(transmittance),
                gradient,
            ),
        )
        local = jnp.stack([transmittance, remaining], axis=1)
        return number + 1, state.at[tiles].set(local, mode="drop"), gradient

    _, state, gradient = lax.while_loop(
        lambda carry: carry[0] < batches, one_batch, (jnp.int32(0), state, gradient)
    )
    return state, gradient


def _parts(local):
    """Split the state of a batch of tiles into one array per row.

    With a single array, every iteration would split and concatenate it.
    """
    return local[:, 0], tuple(local[:, i] for i in range(1, local.shape[1]))


def _any_open(transmittance):
    """Test if any pixel of any tile is unsaturated."""
    # Combines halves first, as whole vectors, because XLA:CPU reduces along an axis
    # element by element.
    values = transmittance.reshape(-1)
    while values.size > 8 and values.size % 2 == 0:
        values = jnp.maximum(*jnp.split(values, 2))
    return jnp.max(values) > 0


def _by_length(isects, batch):
    """Return tiles from most to fewest pairs in whole batches, and the number of these.

    Tiles of one batch run in lockstep, so their lengths should be similar.
    """
    length = isects.ends - isects.starts
    order = longest_first(length)
    tiles = length.shape[0]
    padding = jnp.full(-tiles % batch, tiles, jnp.int32)
    batches = -(-jnp.sum(length > 0, dtype=jnp.int32) // batch)
    return jnp.concatenate([order, padding]), batches


def _tile_rows(tiles, isects, grid, dtype):
    """Return first pair, end, and center (px) of each tile, with empty padding."""
    start = isects.starts.at[tiles].get(mode="fill", fill_value=0)
    end = isects.ends.at[tiles].get(mode="fill", fill_value=0)
    corner = jnp.stack([tiles % grid.columns, tiles // grid.columns]) * grid.tile
    return start, end, corner.astype(dtype) + grid.tile / 2


def _chunk(table, ranks, start, end, position, chunk):
    """Gather ranks [chunk, batch] and their columns, transparent past the end."""
    slot = start + position + jnp.arange(chunk, dtype=jnp.int32)[:, None]
    transparent = table.shape[0] - 1
    rank = ranks.at[slot].get(mode="clip")
    rank = jnp.where(slot < end, rank, transparent)
    rows = table.at[rank].get(mode="clip")
    return rank, tuple(rows[..., i] for i in range(table.shape[1]))


def _pixels(grid, dtype):
    """Return pixel centers relative to the tile center: x, then y, row by row."""
    line = np.arange(grid.tile) - (grid.tile - 1) / 2
    y, x = np.meshgrid(line, line, indexing="ij")
    return jnp.asarray(x.ravel(), dtype), jnp.asarray(y.ravel(), dtype)


def _whiten(rows, center):
    """Return u and v at the tile centers, and their gradients p, r and -r k."""
    mean_x, mean_y, p, k, r = rows[:5]
    dx, dy = center[0] - mean_x, center[1] - mean_y
    return p * dx, r * (dy - k * dx), p, r, -(r * k)


def _alphas(rows, center, spec, grid):
    """Compute opacity exp(-u^2 - v^2), and alpha: [chunk, batch, pixels]."""
    u0, v0, u_x, v_y, v_x = (c[..., None] for c in _whiten(rows, center))
    x, y = _pixels(grid, u0.dtype)
    u = u0 + u_x * x
    v = v0 + v_x * x + v_y * y
    raw = jnp.exp(rows[5][..., None] - u * u - v * v)
    return raw, jnp.where(
        raw >= spec.alpha_threshold, jnp.minimum(raw, spec.alpha_max), 0
    )


@jax.custom_jvp
def _straight_through(raw, alpha):
    """Return `alpha` with the derivative of `raw` wherever alpha is positive."""
    return alpha


@_straight_through.defjvp
def _straight_through_jvp(primals, tangents):
    _, alpha = primals
    return alpha, jnp.where(alpha > 0, tangents[0], 0)


def _pass_through(transmittance, alpha, spec):
    """Return the transmittance behind one Gaussian, and where it was rendered."""
    # A product, not T - alpha T: two alphas of 0.99 leave 0.99999e-4, and rounding of
    # the difference could exceed the threshold.
    remaining_light = transmittance * (1 - alpha)
    is_rendered = remaining_light > spec.transmittance_threshold
    return jnp.where(is_rendered, remaining_light, -jnp.abs(transmittance)), is_rendered


def _composite(transmittance, channels, alpha, rows, spec):
    """Return transmittance and channels behind the Gaussians of a chunk."""
    for i in range(alpha.shape[0]):
        before = transmittance
        transmittance, is_rendered = _pass_through(before, alpha[i], spec)
        weight = jnp.where(is_rendered, before * alpha[i], 0)
        channels = tuple(
            channel + weight * rows[SHAPE_COLUMNS + c][i][:, None]
            for c, channel in enumerate(channels)
        )
    return transmittance, channels


def _trace_back(transmittance, remaining, raw, alpha, rows, pixel_gradient, spec):
    """Return the state, compositing weights, and d loss / d exponent of all pairs."""
    weights, grads = [], []
    for i in range(alpha.shape[0]):
        before = transmittance
        transmittance, is_rendered = _pass_through(before, alpha[i], spec)
        weight = jnp.where(is_rendered, before * alpha[i], 0)
        weight_gradient = sum(
            rows[SHAPE_COLUMNS + c][i][:, None] * pixel_gradient[:, c]
            for c in range(pixel_gradient.shape[1])
        )
        remaining = remaining - weight * weight_gradient
        grad = before * weight_gradient - remaining / (1 - alpha[i])
        # d alpha / d exponent is alpha itself, which is zero below the cutoff.
        if spec.clamp_gradient == "zero":
            has_gradient, along_exponent = (
                is_rendered & (alpha[i] < spec.alpha_max),
                alpha[i],
            )
        else:
            has_gradient, along_exponent = is_rendered & (alpha[i] > 0), raw[i]
        weights.append(weight)
        grads.append(jnp.where(has_gradient, grad * along_exponent, 0))
    return transmittance, remaining, jnp.stack(weights), jnp.stack(grads)


def _pair_gradients(rows, center, weight, grad, pixel_gradient, grid):
    """Compute the gradient of the table's columns per pair: [chunk, batch, columns].

    Moments are relative to the tile center, where u and v of a visible Gaussian are of
    order one. Relative to a mean 1e4 px away they would cancel in float32.
    """
    moments = _moments(grad, grid)
    total, x, y, xx, xy, yy = moments
    u0, v0, u_x, v_y, v_x = _whiten(rows, center)
    u_moment, v_moment = u_x * x, v_y * y + v_x * x
    sum_u = u0 * total + u_moment
    sum_v = v0 * total + v_moment
    sum_uu = u0 * (sum_u + u_moment) + u_x * u_x * xx
    sum_vv = v0 * (sum_v + v_moment) + (
        v_y * v_y * yy + 2 * v_y * v_x * xy + v_x * v_x * xx
    )
    sum_uv = u0 * sum_v + v0 * u_moment + u_x * (v_y * xy + v_x * xx)
    columns = [
        2 * (u_x * sum_u + v_x * sum_v),
        2 * v_y * sum_v,
        -2 * sum_uu / u_x,
        2 * v_y * sum_uv / u_x,
        -2 * sum_vv / v_y,
        total,
    ]
    # Products of small matrices per tile make this pass a seventh faster than sums over
    # pixels, and a third with 16 channels. Half of that is lost with tiles as second
    # axis ("kbc").
    color_gradient = exact_einsum("kbp,bcp->bkc", weight, pixel_gradient).swapaxes(0, 1)
    return jnp.concatenate([jnp.stack(columns, axis=-1), color_gradient], axis=-1)


def _moments(grad, grid):
    """Sum the gradient times 1, x, y, x^2, x y and y^2 over a tile's pixels."""
    x, y = _pixels(grid, grad.dtype)
    zero = jnp.zeros_like(x)
    # One product with eight columns, two of them unused: 0.36 ns per pair and pixel,
    # compared with 0.51 for six columns and 1.1 for sums over rows, then columns.
    basis = jnp.stack([zero + 1, x, y, x * x, x * y, y * y, zero, zero], axis=1)
    sums = exact_product(grad.reshape(-1, x.shape[0]), basis)
    return tuple(sums[:, i].reshape(grad.shape[:-1]) for i in range(6))
