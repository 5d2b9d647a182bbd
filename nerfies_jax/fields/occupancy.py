"""Occupancy grid: cells of space in which samples must not be skipped.

Cells are uniform in contracted space (`nn.grids.contract`): they have equal sizes in
the captured volume and grow outside of it, up to twice its half side. Space farther
away counts as occupied. This follows Müller et al. 2022, arXiv:2201.05989, appendix
E.2, except that the grid is recomputed from the current field instead of being updated.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Key

REACH = 1.5  # extent of the grid in contracted space, twice the half side in the field

Cells = Bool[Array, "cells cells cells"]


@dataclasses.dataclass(frozen=True)
class OccupancySpec:
    """Settings of the occupancy grid, for static scenes.

    Regions of a dynamic scene do not stay empty, so it is for static scenes only. The
    grid is recomputed after `start` steps and then every `every` steps. This takes as
    long as six steps of a small field on a grid. `candidates` is the number of
    candidate rays for each ray of a step. `anywhere` is the fraction of a step's rays
    that need not meet an occupied cell, so that surfaces can appear in empty space. The
    first samples of a ray are mostly in occupied cells: `empty` is the density of
    samples in empty cells relative to that in occupied cells.
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
    """Sample a random point in each of some cells.

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
    return _contract_back((corner.astype(dtype) + jitter) / cells, half_side)


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
    return _contract_back(
        jnp.stack(jnp.meshgrid(*3 * [share], indexing="ij"), -1), half_side
    )


def _contract_back(share, half_side):
    """Convert positions in [0, 1] over the grid to units of the field."""
    coordinates = REACH * (2 * share - 1)
    size = jnp.max(jnp.abs(coordinates), axis=-1, keepdims=True)
    # Inverse of (2 - 1 / |x|) x / |x|, which exists because REACH is below 2.
    distance = 1 / (jnp.maximum(size, 1) * (2 - jnp.maximum(size, 1)))
    return half_side * coordinates * distance


def dilate(grid: Cells) -> Cells:
    """Add all cells that touch an occupied cell at a face, an edge or a corner.

    Args:
      grid: Occupied cells, [cells, cells, cells].

    Returns:
      The enlarged set of cells.
    """
    window = (3, 3, 3)
    return jax.lax.reduce_window(
        grid, False, jax.lax.bitwise_or, window, (1, 1, 1), "SAME"
    )


def at(
    grid: Cells, point: Float[Array, "*points 3"], half_side: float
) -> Bool[Array, "*points"]:
    """Look up points in the occupancy grid.

    Args:
      grid: Occupied cells, [cells, cells, cells].
      point: Points in units of the field, [..., 3].
      half_side: Half side of the box in units of the field.

    Returns:
      Booleans [...], True in an occupied cell or outside of the grid.
    """
    cells = grid.shape[0]
    # Coordinates are separate arrays, because arrays of points take twice the time.
    coordinates = [point[..., axis] / half_side for axis in range(3)]
    beyond = functools.reduce(jnp.maximum, [jnp.abs(along) for along in coordinates])
    beyond = jnp.maximum(beyond, 1)
    contraction = (2 - 1 / beyond) / beyond
    place = [
        jnp.floor((along * contraction / REACH + 1) * (cells / 2)).astype(jnp.int32)
        for along in coordinates
    ]
    inside = functools.reduce(
        jnp.logical_and, [(cell >= 0) & (cell < cells) for cell in place]
    )
    nearest = tuple(jnp.clip(cell, 0, cells - 1) for cell in place)
    return ~inside | grid[nearest]
