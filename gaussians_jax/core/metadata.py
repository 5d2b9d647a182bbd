"""Metadata of a capture that a scene of Gaussians is compiled with."""

import dataclasses
import math


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

    extent: float
    background: tuple[float, float, float]
    frames: int
    exposures: tuple[tuple[int, int, float], ...] = ((0, 0, 0.0),)
    box: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    near: float = math.inf
    depth: float = 1.0
    times: int | None = None
    distorted: bool = False

    @property
    def moments(self) -> int:
        """Number of distinct training times, which several cameras may share."""
        return self.frames if self.times is None else self.times
