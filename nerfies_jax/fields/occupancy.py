"""Occupancy grid: cells of space in which samples must not be skipped.

Cells are uniform in contracted space (`nets.grids.contract`): uniform in the captured
volume, and growing around it up to twice its half side. Space outside counts as
occupied. The idea is that of Müller et al. 2022, arXiv:2201.05989, appendix E.2. Their
grid is updated during training, this one is recomputed from the current field.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Key

REACH = 1.5  # of the cells, in contracted space: twice the half-side in the field

Cells = Bool[Array, "cells cells cells"]


@dataclasses.dataclass(frozen=True)
class OccupancySpec:
    """Settings of the occupancy grid, for static scenes.

    No region of a dynamic scene stays empty. The grid is recomputed after `start` steps
    and then at every multiple of `every`, for any length of the run, since it takes as
    long as six steps of a small field on a grid. `candidates` rays are drawn for each
    ray of a step. `anywhere` is the share of a step's rays that need not meet an
    occupied cell, so that surfaces which appear in empty space are found. The first
    samples of every ray are in occupied cells, except for `empty` of them to one, over
    the same length.
    """

    start: int = 100
    every: int = 100
    candidates: int = 3
    anywhere: float = 0.25
    empty: float = 0.05

    def __post_init__(self):
        if min(self.start, self.every) < 1 or self.candidates < 2:
            raise ValueError(
                "start and every are at least 1 step and candidates at least 2 rays, "
                f"got start={self.start}, every={self.every}, "
                f"candidates={self.candidates}"
            )
        if not 0 <= self.anywhere < 1:
            raise ValueError(f"anywhere={self.anywhere} must lie in [0, 1)")
        if not 0 < self.empty <= 1:
            raise ValueError(
                f"empty={self.empty} must lie in (0, 1]: what no sample meets stays as "
                "it is for good"
            )


def random_points(
    key: Key[Array, ""],
    index: Int[Array, "*cells"],
    cells: int,
    half_side: float,
    dtype: DTypeLike,
) -> Float[Array, "*cells 3"]:
    """Draw a random point in each of some cells.

    Args:
      key: PRNG key.
      index: Flat indices of the cells, [...].
      cells: Number of cells along an axis.
      half_side: Half side of the box in units of the field.
      dtype: Floating-point type of the result.

    Returns:
      Points in units of the field, [..., 3].
    """
    corner = jnp.stack(jnp.unravel_index(index, (cells,) * 3), axis=-1)
    jitter = jax.random.uniform(key, corner.shape, dtype)
    return _placed((corner.astype(dtype) + jitter) / cells, half_side)


def corners(
    cells: int, half_side: float, dtype: DTypeLike
) -> Float[Array, "corners corners corners 3"]:
    """Return the corners of all cells.

    Args:
      cells: Number of cells along an axis.
      half_side: Half side of the box in units of the field.
      dtype: Floating-point type of the result.

    Returns:
      Points in units of the field, [cells + 1, cells + 1, cells + 1, 3].
    """
    share = jnp.arange(cells + 1, dtype=dtype) / cells
    return _placed(jnp.stack(jnp.meshgrid(*3 * [share], indexing="ij"), -1), half_side)


def _placed(share, half_side):
    """Places in units of the field, by their shares of the cells' width."""
    contracted = REACH * (2 * share - 1)
    size = jnp.max(jnp.abs(contracted), axis=-1, keepdims=True)
    # The inverse of (2 - 1 / |x|) x / |x|; REACH is below 2.
    away = 1 / (jnp.maximum(size, 1) * (2 - jnp.maximum(size, 1)))
    return half_side * contracted * away


def dilated(occupied: Cells) -> Cells:
    """Add every cell that touches an occupied one, at a face, an edge or a corner.

    Args:
      occupied: Occupied cells, [cells, cells, cells].

    Returns:
      The enlarged set of cells.
    """
    window = (3, 3, 3)
    return jax.lax.reduce_window(
        occupied, False, jax.lax.bitwise_or, window, (1, 1, 1), "SAME"
    )


def at(
    occupied: Cells, point: Float[Array, "*points 3"], half_side: float
) -> Bool[Array, "*points"]:
    """Look up points in the occupancy grid.

    Args:
      occupied: Occupied cells, [cells, cells, cells].
      point: Points in units of the field, [..., 3].
      half_side: Half side of the box in units of the field.

    Returns:
      Booleans [...], True in an occupied cell or outside of the grid.
    """
    cells = occupied.shape[0]
    # Coordinate by coordinate: a point in three lanes of a vector takes twice the time.
    scaled = [point[..., axis] / half_side for axis in range(3)]
    beyond = functools.reduce(jnp.maximum, [jnp.abs(along) for along in scaled])
    beyond = jnp.maximum(beyond, 1)
    shrunk = (2 - 1 / beyond) / beyond
    place = [
        jnp.floor((along * shrunk / REACH + 1) * (cells / 2)).astype(jnp.int32)
        for along in scaled
    ]
    inside = functools.reduce(
        jnp.logical_and, [(cell >= 0) & (cell < cells) for cell in place]
    )
    nearest = tuple(jnp.clip(cell, 0, cells - 1) for cell in place)
    return ~inside | occupied[nearest]
