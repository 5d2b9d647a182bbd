"""Metadata of a capture that a scene of Gaussians is compiled with."""

import dataclasses
import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from nerfies_jax.capture.scene_metadata import Number


@dataclasses.dataclass(frozen=True)
class SceneMetadata:
    """Sizes and bounds of a capture that a scene of Gaussians depends on.

    Attributes:
      extent: Spread of the cameras in scene units.
      background: Color behind the Gaussians, sRGB in [0, 1].
      frames: Number of training frames.
      exposures: For each appearance id, two row indices of the exposure table and the
        interpolation weight of the second, as in
        `nerfies_jax.capture.scene_metadata`.
      box: Minimum and maximum corner of the observed volume in scene units. None if
        unknown.
      near: Smallest z-depth of the observed volume in scene units.
      depth: z-depth in the middle of the observed volume in scene units.
      times: Number of distinct frame times. None if each frame has its own.
      distorted: True if the cameras have lens distortion.
    """

    extent: Number
    background: tuple[Number, Number, Number]
    frames: int
    exposures: tuple[tuple[int, int, float], ...] | Float[Array, "appearances 3"] = (
        (0, 0, 0.0),
    )
    box: tuple[tuple[Number, ...], tuple[Number, ...]] | None = None
    near: float = math.inf
    depth: Number = 1.0
    times: int | None = None
    distorted: bool = False

    @property
    def timestamps(self) -> int:
        """Number of distinct training times, which several cameras may share."""
        return self.frames if self.times is None else self.times

    @property
    def numbers(self) -> dict[str, Any]:
        """Fields that programs take as arguments (`training.programs`).

        The others determine shapes, or which operations there are. `near` is rounded
        instead (`scene.spec.raster_of`), because the settings of the rasterizer must be
        hashable.
        """
        exposures: Any = self.exposures
        if not isinstance(exposures, jax.Array):
            exposures = np.asarray(exposures, float)
        return {
            "extent": self.extent,
            "background": self.background,
            "exposures": exposures,
            "box": self.box,
            "depth": self.depth,
        }


def is_traced(value: Any) -> bool:
    """Test if a value belongs to a program that is being traced.

    Such numbers of a capture cannot be validated. The same ones are validated when the
    model is built from the capture.

    Args:
      value: A pytree.

    Returns:
      True if any leaf is traced.
    """
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value))
