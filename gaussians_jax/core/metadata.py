"""Metadata of a capture that a scene of Gaussians is compiled with."""

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class SceneMetadata:
    """Sizes of a capture that a scene of Gaussians depends on.

    Attributes:
      extent: Spread of the cameras, scene units.
      background: Color behind the Gaussians, sRGB in [0, 1].
      frames: Number of training frames.
      exposures: For each appearance id the two rows of the exposure table it lies
        between and its position between them, as in
        `nerfies_jax.capture.scene_metadata`.
      box: Low and high corner of the observed volume, scene units. None: unknown.
      near: Smallest z-depth of the observed volume, scene units.
      depth: z-depth halfway into the observed volume, scene units.
      times: Number of distinct frame times. None: each frame has its own.
    """

    extent: float
    background: tuple[float, float, float]
    frames: int
    exposures: tuple[tuple[int, int, float], ...] = ((0, 0, 0.0),)
    box: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    near: float = math.inf
    depth: float = 1.0
    times: int | None = None

    @property
    def moments(self) -> int:
        """Number of distinct training times, fewer than frames with several cameras."""
        return self.frames if self.times is None else self.times
