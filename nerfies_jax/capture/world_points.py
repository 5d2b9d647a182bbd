"""Points and directions of the world as cameras of a capture see them."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.capture.capture import PointCloud
from nerfies_jax.geometry import camera
from nerfies_jax.geometry.camera import Camera

UNSEEN = 128  # gray value of points that no frame shows


def unit(up: Sequence[float] | None) -> tuple[float, float, float] | None:
    """Normalize a direction from a file.

    Args:
      up: A direction, or None.

    Returns:
      The unit vector, or None if there is none or it is zero.
    """
    if up is None or not np.linalg.norm(up) > 0:
        return None
    return tuple((np.array(up) / np.linalg.norm(up)).tolist())


def mean_up(cameras: Camera) -> np.ndarray:
    """Return the mean of the up directions of cameras.

    Args:
      cameras: Cameras, [frames].

    Returns:
      The mean of unit vectors, [3], which is shorter than one.
    """
    return -np.asarray(cameras.camera_from_world, np.float64)[:, 1].mean(axis=0)


def up_direction(cameras: Camera) -> tuple[float, float, float] | None:
    """Return the mean up direction of cameras.

    Args:
      cameras: Cameras, [frames].

    Returns:
      A unit vector, or None if the directions cancel.
    """
    mean = mean_up(cameras)
    length = np.linalg.norm(mean)
    if length < 0.1:  # the up directions cancel
        return None
    return tuple((mean / length).tolist())


_project = jax.jit(
    lambda view, points: (
        *jax.vmap(camera.project, (None, 0))(view, points),
        jax.vmap(camera.projectable, (None, 0))(view, points),
    )
)


def pixels_of(
    cameras: Camera, row: int, position: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points into one frame.

    Args:
      cameras: Cameras, [frames].
      row: Index of the frame.
      position: Points in scene units, [points, 3].
      size: Width and height of the image in pixels.

    Returns:
      Pixel positions [points, 2], z-depths [points], and booleans of the points inside
      the image [points].
    """
    view = jax.tree.map(lambda leaf: jnp.asarray(leaf[row]), cameras)
    pixel, depth, projectable = map(np.asarray, _project(view, jnp.asarray(position)))
    inside = (pixel >= 0).all(-1) & (pixel < np.asarray(size)).all(-1)
    return pixel, depth, inside & projectable & (depth > 0)


def near_origin(cameras: Camera, position: np.ndarray) -> tuple[Camera, np.ndarray]:
    """Move cameras and points of a world to the origin together, in float64.

    Map coordinates of millions of meters have a resolution of half a meter in float32.

    Args:
      cameras: Cameras with float64 positions, [frames].
      position: Points of the same world, [points, 3].

    Returns:
      Cameras and points in float32, with the median point at the origin.
    """
    origin = np.median(position, axis=0)
    camera_position = (cameras.position - origin).astype(np.float32)
    points = (position - origin).astype(np.float32)
    return cameras._replace(position=camera_position), points


def colored_points(
    position: np.ndarray,
    images: np.ndarray,
    cameras: Camera,
    rows: np.ndarray,
    skip: np.ndarray | None,
) -> PointCloud:
    """Color points with the median over up to 16 frames.

    Occlusion is not tested, but the median is robust to it in a minority of the frames.

    Args:
      position: Points in scene units, [points, 3].
      images: uint8 images, [frames, height, width, 3].
      cameras: Cameras, [frames].
      rows: Frames to use.
      skip: True for pixels to ignore, [frames, height, width], or None.

    Returns:
      The points with colors, gray if no frame shows them.
    """
    size = (images.shape[2], images.shape[1])
    rows = rows[np.linspace(0, len(rows) - 1, min(16, len(rows))).astype(int)]
    samples = np.full((len(rows), len(position), 3), np.nan, np.float32)
    for sample, row in zip(samples, rows.tolist(), strict=True):
        pixel, _, inside = pixels_of(cameras, row, position, size)
        x, y = np.where(inside[:, None], pixel, 0).astype(int).T
        if skip is not None:
            inside &= ~skip[row, y, x]
        sample[inside] = images[row, y, x][inside]
    visible = ~np.isnan(samples[..., 0]).all(0)
    color = np.full((len(position), 3), UNSEEN, np.uint8)
    if visible.any():
        color[visible] = np.round(np.nanmedian(samples[:, visible], axis=0))
    return PointCloud(position, color)
