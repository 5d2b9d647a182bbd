"""Where a field may be dense: cells of space that samples need not skip.

The cells are even in contracted space (`nets.grids.contract`): even in the filmed
volume, and growing around it up to twice its half-side. What is beyond counts as
occupied. The idea is that of Müller et al. 2022, arXiv:2201.05989, appendix E.2; theirs
trains with it, these cells are surveyed once of a trained field.
"""

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Key

REACH = 1.5  # of the cells, in contracted space: twice the half-side in the field

Cells = Bool[Array, "cells cells cells"]


def random_points(
    key: Key[Array, ""],
    index: Int[Array, "*cells"],
    cells: int,
    half_side: float,
    dtype: DTypeLike,
) -> Float[Array, "*cells 3"]:
    """A random point in each of some cells, by their flat index; units of the field."""
    corner = jnp.stack(jnp.unravel_index(index, (cells,) * 3), axis=-1)
    jitter = jax.random.uniform(key, corner.shape, dtype)
    share = (corner.astype(dtype) + jitter) / cells
    contracted = REACH * (2 * share - 1)
    size = jnp.max(jnp.abs(contracted), axis=-1, keepdims=True)
    # The inverse of (2 - 1 / |x|) x / |x|; REACH is below 2.
    away = 1 / (jnp.maximum(size, 1) * (2 - jnp.maximum(size, 1)))
    return half_side * contracted * away


def dilated(occupied: Cells) -> Cells:
    """With every cell that touches an occupied one, at a side, an edge or a corner."""
    window = (3, 3, 3)
    return jax.lax.reduce_window(
        occupied, False, jax.lax.bitwise_or, window, (1, 1, 1), "SAME"
    )


def at(
    occupied: Cells, point: Float[Array, "*points 3"], half_side: float
) -> Bool[Array, "*points"]:
    """Whether each point, in units of the field, lies in an occupied cell or beyond."""
    cells = occupied.shape[0]
    scaled = point / half_side
    size = jnp.max(jnp.abs(scaled), axis=-1, keepdims=True)
    beyond = jnp.maximum(size, 1)
    contracted = scaled * ((2 - 1 / beyond) / beyond)
    place = jnp.floor((contracted / REACH + 1) * (cells / 2)).astype(jnp.int32)
    inside = jnp.all((place >= 0) & (place < cells), axis=-1)
    x, y, z = (jnp.clip(place[..., axis], 0, cells - 1) for axis in range(3))
    return ~inside | occupied[x, y, z]
