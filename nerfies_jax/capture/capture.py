"""One record for what was filmed, whatever format it came in."""

import dataclasses
import pathlib
from typing import NamedTuple

import numpy as np

from nerfies_jax.geometry.camera import Camera


class PointCloud(NamedTuple):
    """Static scene points, in scene units."""

    position: np.ndarray  # [points, 3] float32
    colour: np.ndarray  # [points, 3] uint8 sRGB


@dataclasses.dataclass(frozen=True)
class Capture:
    """A filmed scene on the host: NumPy only, one row per frame.

    Everything geometric is in scene units: `scene_units = (world - centre) * scale`.
    """

    name: str
    source: str  # the format it was read from, "nerfies", "blender", "colmap", ...
    ids: tuple[str, ...]  # one per frame
    images: np.ndarray  # [frames, height, width, 3] uint8, sRGB, opaque
    cameras: Camera  # NumPy leaves, float32, leading axis frames
    times: np.ndarray  # [frames] float32 in [0, 1] over the whole capture
    train: np.ndarray  # rows to learn from
    heldout: np.ndarray  # rows to score on; never learnt from
    near: float  # scene units along the viewing axis
    far: float
    warp_ids: np.ndarray  # [frames] int32, 0..n-1: which moment
    appearance_ids: np.ndarray  # [frames] int32: which exposure
    camera_ids: np.ndarray  # [frames] int32: which physical camera
    valid: np.ndarray | None = None  # [frames, height, width] bool: pixel was filmed
    moving: np.ndarray | None = None  # [frames, height, width] bool: moves by itself
    depths: np.ndarray | None = None  # [frames, height, width] float32 z-depth; 0 unknown
    points: PointCloud | None = None
    background: tuple[float, float, float] | None = None  # what lies behind, if known
    scale: float = 1.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    path: pathlib.Path | None = None
    notes: tuple[str, ...] = ()  # what the reader found, repaired or left out

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.images.shape[2], self.images.shape[1]
