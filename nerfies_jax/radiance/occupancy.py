"""Where a field may be dense: cells of space that samples need not skip.

The cells are even in contracted space (`nets.grids.contract`): even in the filmed
volume, and growing around it up to twice its half-side. What is beyond counts as
occupied. The idea is that of Müller et al. 2022, arXiv:2201.05989, appendix E.2; theirs
are kept up while training, these are surveyed anew of the field as it is.
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
    """When space is surveyed, and how many rays there are to choose from.

    Of a scene at rest: what moves is empty nowhere for good. After `start` steps and
    then every so many, whatever the length of the run: a survey takes as long as six
    steps of a small field on a grid. `candidates` rays are drawn for each of a step.
    `anywhere` is the share of a step's rays that need not meet anything: what appears
    in empty space is seen by these. The first samples of every ray are in filled cells,
    but for `empty` of them to one, over the same length.
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
    """A random point in each of some cells, by their flat index; units of the field."""
    corner = jnp.stack(jnp.unravel_index(index, (cells,) * 3), axis=-1)
    jitter = jax.random.uniform(key, corner.shape, dtype)
    return _placed((corner.astype(dtype) + jitter) / cells, half_side)


def corners(
    cells: int, half_side: float, dtype: DTypeLike
) -> Float[Array, "corners corners corners 3"]:
    """Where the corners of all cells are, units of the field."""
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
    # Coordinate by coordinate: a point in three lanes of a vector takes twice the time.
    scaled = [point[..., axis] / half_side for axis in range(3)]
    beyond = functools.reduce(jnp.maximum, [jnp.abs(along) for along in scaled])
    beyond = jnp.maximum(beyond, 1)
    shrunk = (2 - 1 / beyond) / beyond
    inside, place = True, []
    for along in scaled:
        cell = jnp.floor((along * shrunk / REACH + 1) * (cells / 2)).astype(jnp.int32)
        inside &= (cell >= 0) & (cell < cells)
        place.append(jnp.clip(cell, 0, cells - 1))
    return ~inside | occupied[tuple(place)]
