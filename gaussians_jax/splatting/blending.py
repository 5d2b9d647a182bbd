"""Front-to-back compositing of sorted pairs, and its gradient, with tiles in lockstep.

The state of a tile is one row of transmittance and one row per channel over its pixels,
with pixels last. The transmittance of a saturated pixel is kept negative, so that no
mask is needed. Both passes go front to back and recompute every alpha.
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
        number, state, used = carry
        tiles = lax.dynamic_slice(order, (number * step.batch,), (step.batch,))
        start, end, middle = _tile_rows(tiles, isects, grid, state.dtype)
        longest = jnp.max(end - start)

        def unfinished(inner):
            position, *_, alive = inner
            return (position < longest) & alive

        def one_chunk(inner):
            position, transmittance, channels, _ = inner
            _, rows = _chunk(table, isects.ranks, start, end, position, step.chunk)
            raw, alpha = _alphas(rows, middle, spec, grid)
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
            unfinished,
            one_chunk,
            (jnp.int32(0), transmittance, channels, _any_open(transmittance)),
        )
        local = jnp.stack([transmittance, *channels], axis=1)
        state = state.at[tiles].set(local, mode="drop")
        used = used.at[tiles].set(count(position), mode="drop")
        return number + 1, state, used

    used = jnp.zeros(grid.tiles, jnp.int32)
    _, state, used = lax.while_loop(
        lambda carry: carry[0] < batches, one_batch, (jnp.int32(0), state, used)
    )
    return state, used


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
    """Add a chunk's part of the gradient of every table entry.

    `state` has two rows: the transmittance, and the part of the loss that is still to
    come through this pixel, S = sum over the remaining Gaussians of w (color . g), plus
    g_T times the final transmittance. Going front to back,

        d loss / d alpha_i = T_i (color_i . g) - S_i / (1 - alpha_i),

    where S_i is the part behind Gaussian i. Only the final image is needed.
    """
    order, batches = _by_length(isects, step.batch)

    def one_batch(carry):
        number, state, gradient = carry
        tiles = lax.dynamic_slice(order, (number * step.batch,), (step.batch,))
        start, end, middle = _tile_rows(tiles, isects, grid, state.dtype)
        longest = jnp.max(end - start)
        toward = cotangent.at[tiles].get(mode="clip")

        def unfinished(inner):
            position, _, _, alive, _ = inner
            return (position < longest) & alive

        def one_chunk(inner):
            position, transmittance, behind, _, gradient = inner
            rank, rows = _chunk(table, isects.ranks, start, end, position, step.chunk)
            raw, alpha = _alphas(rows, middle, spec, grid)
            transmittance, behind, weight, grad = _trace_back(
                transmittance, behind, raw, alpha, rows, toward, spec
            )
            update = _pair_gradients(rows, middle, weight, grad, toward, grid)
            gradient = gradient.at[rank].add(update)
            return (
                position + step.chunk,
                transmittance,
                behind,
                _any_open(transmittance),
                gradient,
            )

        transmittance, (behind,) = _parts(state.at[tiles].get(mode="clip"))
        _, transmittance, behind, _, gradient = lax.while_loop(
            unfinished,
            one_chunk,
            (jnp.int32(0), transmittance, behind, _any_open(transmittance), gradient),
        )
        local = jnp.stack([transmittance, behind], axis=1)
        return number + 1, state.at[tiles].set(local, mode="drop"), gradient

    _, state, gradient = lax.while_loop(
        lambda carry: carry[0] < batches, one_batch, (jnp.int32(0), state, gradient)
    )
    return state, gradient


def _parts(local):
    """Split the state of a batch of tiles into one array per row.

    As one array, every iteration would take it apart and assemble it again.
    """
    return local[:, 0], tuple(local[:, i] for i in range(1, local.shape[1]))


def _any_open(transmittance):
    """Test if any pixel of any tile is unsaturated."""
    # Halves with each other first, whole vectors at once: XLA:CPU reduces along an axis
    # one number after the other.
    most = transmittance.reshape(-1)
    while most.size > 8 and most.size % 2 == 0:
        most = jnp.maximum(*jnp.split(most, 2))
    return jnp.max(most) > 0


def _by_length(isects, batch):
    """Tiles from most to fewest pairs, padded to whole batches, and how many batches.

    Tiles of one batch run in lockstep, so they should be about equally long.
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


def _whitened(rows, middle):
    """Return u and v at the tile centers, and their gradients p, r and -r k."""
    mean_x, mean_y, p, k, r = rows[:5]
    dx, dy = middle[0] - mean_x, middle[1] - mean_y
    return p * dx, r * (dy - k * dx), p, r, -(r * k)


def _alphas(rows, middle, spec, grid):
    """opacity exp(-u^2 - v^2), and alpha with cut and clamp: [chunk, batch, pixels]."""
    u0, v0, u_x, v_y, v_x = (c[..., None] for c in _whitened(rows, middle))
    x, y = _pixels(grid, u0.dtype)
    u = u0 + u_x * x
    v = v0 + v_x * x + v_y * y
    raw = jnp.exp(rows[5][..., None] - u * u - v * v)
    return raw, jnp.where(
        raw >= spec.alpha_threshold, jnp.minimum(raw, spec.alpha_max), 0
    )


@jax.custom_jvp
def _straight_through(raw, alpha):
    """Return `alpha` with the derivative of `raw` wherever something is rendered."""
    return alpha


@_straight_through.defjvp
def _straight_through_jvp(primals, tangents):
    _, alpha = primals
    return alpha, jnp.where(alpha > 0, tangents[0], 0)


def _pass_through(transmittance, alpha, spec):
    """Return the transmittance behind one Gaussian, and where it was rendered."""
    # A product, not T - alpha T: two alphas of 0.99 leave 0.99999e-4, and rounding the
    # difference could put that above the stop.
    passed = transmittance * (1 - alpha)
    drawn = passed > spec.transmittance_threshold
    return jnp.where(drawn, passed, -jnp.abs(transmittance)), drawn


def _composite(transmittance, channels, alpha, rows, spec):
    """Transmittance and channels behind the Gaussians of a chunk."""
    for i in range(alpha.shape[0]):
        before = transmittance
        transmittance, drawn = _pass_through(before, alpha[i], spec)
        weight = jnp.where(drawn, before * alpha[i], 0)
        channels = tuple(
            channel + weight * rows[SHAPE_COLUMNS + c][i][:, None]
            for c, channel in enumerate(channels)
        )
    return transmittance, channels


def _trace_back(transmittance, behind, raw, alpha, rows, toward, spec):
    """New state, compositing weights, and d loss / d exponent of every pair."""
    weights, grads = [], []
    for i in range(alpha.shape[0]):
        before = transmittance
        transmittance, drawn = _pass_through(before, alpha[i], spec)
        weight = jnp.where(drawn, before * alpha[i], 0)
        along = sum(
            rows[SHAPE_COLUMNS + c][i][:, None] * toward[:, c]
            for c in range(toward.shape[1])
        )
        behind = behind - weight * along
        grad = before * along - behind / (1 - alpha[i])
        # d alpha / d exponent is alpha itself, so below the cut it is zero already.
        if spec.clamp_gradient == "zero":
            moves, along_exponent = drawn & (alpha[i] < spec.alpha_max), alpha[i]
        else:
            moves, along_exponent = drawn & (alpha[i] > 0), raw[i]
        weights.append(weight)
        grads.append(jnp.where(moves, grad * along_exponent, 0))
    return transmittance, behind, jnp.stack(weights), jnp.stack(grads)


def _pair_gradients(rows, middle, weight, grad, toward, grid):
    """Compute the gradient of the table's columns per pair: [chunk, batch, columns].

    Moments are taken about the tile center, where u and v of a visible Gaussian are of
    order one. About a mean 1e4 px away they would cancel in float32.
    """
    moments = _moments(grad, grid)
    total, x, y, xx, xy, yy = moments
    u0, v0, u_x, v_y, v_x = _whitened(rows, middle)
    along, lean = u_x * x, v_y * y + v_x * x
    sum_u = u0 * total + along
    sum_v = v0 * total + lean
    sum_uu = u0 * (sum_u + along) + u_x * u_x * xx
    sum_vv = v0 * (sum_v + lean) + (
        v_y * v_y * yy + 2 * v_y * v_x * xy + v_x * v_x * xx
    )
    sum_uv = u0 * sum_v + v0 * along + u_x * (v_y * xy + v_x * xx)
    columns = [
        2 * (u_x * sum_u + v_x * sum_v),
        2 * v_y * sum_v,
        -2 * sum_uu / u_x,
        2 * v_y * sum_uv / u_x,
        -2 * sum_vv / v_y,
        total,
    ]
    # A product of small matrices for each tile, not sums over pixels, takes a seventh
    # off this pass, of 16 channels a third; tiles second ("kbc") lose half of that.
    shades = exact_einsum("kbp,bcp->bkc", weight, toward).swapaxes(0, 1)
    return jnp.concatenate([jnp.stack(columns, axis=-1), shades], axis=-1)


def _moments(grad, grid):
    """Sum the gradient times 1, x, y, x^2, x y and y^2 over a tile's pixels."""
    x, y = _pixels(grid, grad.dtype)
    zero = jnp.zeros_like(x)
    # One product with eight columns, two of them idle: 0.36 ns a pair and pixel against
    # 0.51 for six columns and 1.1 for sums over rows, then columns.
    basis = jnp.stack([zero + 1, x, y, x * x, x * y, y * y, zero, zero], axis=1)
    sums = exact_product(grad.reshape(-1, x.shape[0]), basis)
    return tuple(sums[:, i].reshape(grad.shape[:-1]) for i in range(6))
