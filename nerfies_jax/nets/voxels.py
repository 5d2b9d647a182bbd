"""Features of a point from one dense grid, read at several distances.

Fang et al. 2022 (TiNeuVox), arXiv:2205.15285, "multi-distance interpolation". The text
with its equations was not at hand; its code (hustvl/TiNeuVox, `mult_dist_interp`) is
followed: the grid is read between its own vertices, between every second and between
every fourth, so that one sample trains vertices far enough away to learn from points
that a small network moves. The three share one table, whose size is that of the finest,
and which has it from the first step: the code's grid grows, here strides may open one
after the other (`encode`).
"""

import dataclasses
import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.nets import encoding, grids
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.nets.grids import Tables

MOST_ROWS = 2**26  # 1.6 GB of six floats


@dataclasses.dataclass(frozen=True)
class VoxelGridSpec:
    """A dense grid over a box; the defaults are TiNeuVox-B's.

    `strides` are from coarse to fine. Each feature is followed by `bands` waves of
    itself, as coordinates are. The box is that of `grids.HashGridSpec`; a point beyond
    it has the features of the nearest in it, where the paper drops it, or with
    `contract` space is contracted, which leaves the box half the vertices of a side.
    """

    cells: int = 160  # along an axis
    features: int = 6  # floats of a row
    strides: tuple[int, ...] = (4, 2, 1)
    bands: int = 2
    half_side: float = 1.0
    contract: bool = False

    def __post_init__(self):
        if self.features < 1 or self.cells < 1 or (self.cells + 1) ** 3 > MOST_ROWS:
            raise ValueError(
                f"a voxel grid needs features >= 1 and 1 <= cells <= "
                f"{round(MOST_ROWS ** (1 / 3)) - 1}, got features={self.features}, "
                f"cells={self.cells}"
            )
        wrong = [s for s in self.strides if s < 1 or self.cells % s]
        if wrong or not self.strides:
            raise ValueError(
                f"strides={self.strides} of {self.cells} cells: give at least one, and "
                "each must divide the number of cells"
            )
        if not 0 < self.half_side < math.inf:
            raise ValueError(f"half_side={self.half_side} must be positive and finite")
        EncodingSpec(self.bands)  # refuses wrong bands

    @property
    def levels(self) -> int:
        """What is opened one by one, coarse to fine."""
        return len(self.strides)

    def width(self, dimensions: int) -> int:
        """Features made of a point, which has three coordinates."""
        if dimensions != 3:
            raise ValueError(f"a voxel grid is of 3 dimensions, not of {dimensions}")
        return EncodingSpec(self.bands).width(self.levels * self.features)


def init(spec: VoxelGridSpec, key=None, dtype=jnp.float32) -> Tables:
    """Nothing anywhere, as published; no key is used."""
    return (jnp.zeros(((spec.cells + 1) ** 3, spec.features), dtype),)


def encode(
    spec: VoxelGridSpec,
    tables: Tables,
    point: Float[Array, "3"],
    window: Float[Array, " levels"] | None = None,
) -> Float[Array, " encoded"]:
    """Features of one point in units of the field, the widest stride first.

    `window` weighs the strides (`encoding.anneal`); None leaves them all open.
    """
    (table,) = tables
    place = grids.unit_place(point, spec.half_side, spec.contract)
    found = [
        grids.level_features(table, place, spec.cells, stride)
        for stride in spec.strides
    ]
    if window is not None:
        found = [part * window[level] for level, part in enumerate(found)]
    return encoding.encode(EncodingSpec(spec.bands), jnp.concatenate(found), None)
