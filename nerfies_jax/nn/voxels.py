"""Dense voxel grid with multi-distance interpolation, as in TiNeuVox.

Fang et al. 2022, arXiv:2205.15285. The implementation follows the published code
(hustvl/TiNeuVox, `mult_dist_interp`), because the paper's equations were not available.
The grid is interpolated between its own vertices, between every second and between
every fourth, so that a sample also trains vertices farther away, from which points
displaced by a small network can learn. The three strides share one table, which has its
full size from the first step. The published grid grows during training. Here the
weights of the strides may be annealed one after the other (`encode`).
"""

import dataclasses
import math

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from nerfies_jax.nn import encoding, grids
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.grids import Tables

MOST_ROWS = 2**26  # 1.6 GB with six floats per row


@dataclasses.dataclass(frozen=True)
class VoxelGridSpec:
    """Settings of a dense grid over a box. The defaults are those of TiNeuVox-B.

    `strides` are from coarse to fine. Features are followed by their positional
    encoding with `bands` bands, as coordinates are. The box is that of
    `grids.HashGridSpec`. A point outside has the features of the nearest point of the
    box. The paper ignores such points. With `contract` space is contracted, so that
    half of the vertices along a side are inside the box.
    """

    cells: int = 160  # along an axis
    features: int = 6  # floats per row
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
                f"strides={self.strides} must not be empty, and each must divide "
                f"cells={self.cells}"
            )
        if not 0 < self.half_side < math.inf:
            raise ValueError(f"half_side={self.half_side} must be positive and finite")
        EncodingSpec(self.bands)  # checks the number of bands

    @property
    def levels(self) -> int:
        """Number of strides. Training may enable them one after the other."""
        return len(self.strides)

    def width(self, dimensions: int) -> int:
        """Return the number of features of a point.

        Args:
          dimensions: Number of coordinates of the point, which must be 3.

        Returns:
          The length of `encode`'s result.

        Raises:
          ValueError: If `dimensions` is not 3.
        """
        if dimensions != 3:
            raise ValueError(
                f"a voxel grid has 3 dimensions, but the points have {dimensions}"
            )
        return EncodingSpec(self.bands).width(self.levels * self.features)


def init(spec: VoxelGridSpec, key=None, dtype: DTypeLike = jnp.float32) -> Tables:
    """Initialize the grid with zeros, as published.

    Args:
      spec: Settings of the grid.
      key: Not used.
      dtype: Floating-point type of the table.

    Returns:
      A tuple of one table, [(cells + 1)**3, features].
    """
    return (jnp.zeros(((spec.cells + 1) ** 3, spec.features), dtype),)


def encode(
    spec: VoxelGridSpec,
    tables: Tables,
    point: Float[Array, "3"],
    window: Float[Array, " levels"] | None = None,
) -> Float[Array, " encoded"]:
    """Interpolate the features of one point, the widest stride first.

    Args:
      spec: Settings of the grid.
      tables: The table, in a tuple.
      point: Point in units of the field, [3].
      window: Weights of the strides (`encoding.anneal`), [levels]. None is a weight of
        one for all strides.

    Returns:
      Features [spec.width(3)], followed by their positional encoding.
    """
    (table,) = tables
    place = grids.unit_place(point, spec.half_side, spec.contract)
    by_stride = [
        grids.level_features(table, place, spec.cells, stride)
        for stride in spec.strides
    ]
    if window is not None:
        by_stride = [part * window[level] for level, part in enumerate(by_stride)]
    return encoding.encode(EncodingSpec(spec.bands), jnp.concatenate(by_stride), None)
