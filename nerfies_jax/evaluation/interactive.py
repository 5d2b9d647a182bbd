"""Cameras, image sizes and channels of an interactive viewer, without its GUI."""

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from nerfies_jax.evaluation.renderer import to_uint8
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training.model import Rendering
from nerfies_jax.visualization import panels
from nerfies_jax.visualization.panels import Colored

CHANNELS = ("color", "depth", "opacity", "motion")
MOVING_SECONDS = 0.1  # time limit of an image while the view changes
SKIPPED_SECONDS = 0.5  # levels are skipped if a finer one takes less than this
SHORTEST_SIDE_PX = 12


class Eye(NamedTuple):
    """Viewpoint of an interactive viewer."""

    quaternion: tuple[float, ...]  # w x y z, world from camera; right, down, forward
    position: tuple[float, ...]  # scene units
    fov_rad: float  # vertical
    aspect: float  # width of the window over its height


class Look(NamedTuple):
    """Time, channel and variant that a viewer requests."""

    time: float  # in [0, 1]
    channel: str = "color"  # one of `CHANNELS`
    without: tuple[str, ...] = ()  # disabled effects
    appearance: int = 0  # id


def camera_of(eye: Eye, size: tuple[int, int]) -> Camera:
    """Return the camera of a viewpoint for an image that is stretched to the window.

    The pixel aspect compensates for the stretching, so that images of one size fill
    windows of any shape. Every image size needs a compiled program.

    Args:
      eye: Viewpoint, with the aspect of the window.
      size: Width and height of the image in pixels.

    Returns:
      A camera with NumPy leaves.
    """
    width, height = size
    vertical_px = height / 2 / math.tan(eye.fov_rad / 2)
    focal_px = width / height / eye.aspect * vertical_px
    rotation = Rotation.from_quat(eye.quaternion, scalar_first=True).as_matrix()
    camera = cameras.pinhole(rotation.T, eye.position, focal_px, size)
    aspect: Any = np.float32(vertical_px / focal_px)
    return camera._replace(pixel_aspect=aspect)


class Pyramid(NamedTuple):
    """Images of one view at several levels, each twice the size of the previous one.

    All levels are rendered in tiles of one size, so that one compiled program serves
    all of them, a change of the view waits for at most one tile, and the finest level
    is always reached, however long a tile takes.
    """

    tile: tuple[
        int, int
    ]  # width and height in pixels, also those of the coarsest level
    levels: int

    def size(self, level: int) -> tuple[int, int]:
        """Return the image size of a level.

        Args:
          level: Index of the level, 0 for the coarsest.

        Returns:
          Width and height in pixels.
        """
        width, height = self.tile
        return width << level, height << level

    def tiles(self, level: int) -> list[tuple[int, int]]:
        """Return the tiles of a level, beginning at the center.

        Args:
          level: Index of the level, 0 for the coarsest.

        Returns:
          Columns and rows of the tiles, `4**level` of them.
        """
        side = 1 << level
        center = (side - 1) / 2
        cells = [(column, row) for row in range(side) for column in range(side)]
        return sorted(cells, key=lambda c: max(abs(c[0] - center), abs(c[1] - center)))


def pyramid(full: tuple[int, int], tile_pixels: int) -> Pyramid:
    """Divide images of a size into tiles of at most about `tile_pixels`.

    Args:
      full: Width and height of the image in pixels.
      tile_pixels: Number of pixels of a tile.

    Returns:
      The pyramid. Its finest level has the size `full`, or a few pixels more if that is
      not divisible.
    """
    levels = 1
    while True:
        width, height = (math.ceil(side / (1 << levels - 1)) for side in full)
        small = width * height <= tile_pixels
        if small or min(width, height) < 2 * SHORTEST_SIDE_PX:
            return Pyramid((width, height), levels)
        levels += 1


def tile_camera(camera: Camera, pyramid: Pyramid, cell: tuple[int, int]) -> Camera:
    """Return the camera of one tile of an image.

    Args:
      camera: Camera of the whole image of a level.
      pyramid: The pyramid.
      cell: Column and row of the tile.

    Returns:
      The camera with its principal point shifted.
    """
    corner = np.multiply(cell, pyramid.tile)
    principal_point: Any = np.asarray(camera.principal_point_px) - corner
    return camera._replace(principal_point_px=principal_point.astype(np.float32))


def next_level(
    tile_seconds: float | None, levels: int, complete: int | None, moving: bool
) -> int | None:
    """Return the level of a pyramid to render next.

    Args:
      tile_seconds: Seconds to render a tile, None before the first one.
      levels: Number of levels.
      complete: The finest level of this view that has been rendered, or None.
      moving: True while the view changes.

    Returns:
      Index of the level, None if there is nothing to do.
    """
    level_seconds = [(tile_seconds or 0.0) * 4**level for level in range(levels)]
    if complete is None:
        fast = (
            level
            for level, seconds in enumerate(level_seconds)
            if seconds <= MOVING_SECONDS
        )
        return 0 if tile_seconds is None else max(fast, default=0)
    if moving or complete + 1 == levels:
        return None
    finer = range(complete + 1, levels)
    fast_levels = [level for level in finer if level_seconds[level] <= SKIPPED_SECONDS]
    return max(fast_levels, default=complete + 1)


def as_channel(
    channel: str,
    rendering: Rendering,
    distance: np.ndarray | None = None,
    limits: tuple[float, float] | None = None,
) -> Colored:
    """Convert one channel of a rendering to an image.

    Args:
      channel: One of `CHANNELS`.
      rendering: The rendering.
      distance: Displacement of the surface visible in each pixel, in scene units,
        [height, width]. Required for "motion".
      limits: Values of the two ends of the color map for depth and motion, for a common
        range of several images. None for the range of this image.

    Returns:
      The image with the values that its color map spans.

    Raises:
      ValueError: If the channel is unknown, or "motion" is requested without
        `distance`.
    """
    if channel == "color":
        return Colored(to_uint8(np.asarray(rendering.color)), 0.0, 1.0)
    if channel == "opacity":
        gray = to_uint8(np.asarray(rendering.alpha))[..., None]
        return Colored(np.repeat(gray, 3, axis=-1), 0.0, 1.0)
    if channel == "depth":
        solid = np.asarray(rendering.alpha) > 0.5
        return panels.color_depth(np.asarray(rendering.depth), solid, limits)
    if channel == "motion" and distance is not None:
        return panels.color_distance(distance, 0.0 if limits is None else limits[1])
    raise ValueError(
        f"channel={channel!r} must be one of {', '.join(CHANNELS)}, and motion needs "
        "`distance`"
    )
