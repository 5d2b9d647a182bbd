"""Normalization of a scene's position and scale, and point cloud files."""

import pathlib
from typing import NamedTuple

import numpy as np

from nerfies_jax.capture import ply_files
from nerfies_jax.capture.capture import CaptureError, PointCloud
from nerfies_jax.capture.world_points import UNSEEN
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.rays import across_ray

MAX_POINTS = 50_000_000
# Cameras that differ by less than this share of their coordinates share a position.
SAME_PLACE = 1e-9
INLIERS = 0.95  # share of the points, nearest to their median, that the box encloses
# Depths beyond these quantiles are outliers. The margins widen the range between the
# planes. The near margin is large, since moving objects stand in front of the points of
# structure from motion.
QUANTILES, FAR_MARGIN = (0.001, 0.999), 1.2
NEAR_MARGIN = 0.5


class Placement(NamedTuple):
    """Transform from world to scene units, and near and far planes in scene units."""

    center: tuple[float, float, float]
    scale: float
    near: float
    far: float


def place_by_points(
    points: np.ndarray, positions: np.ndarray, depths: np.ndarray
) -> Placement:
    """Center the bounding box of points and cameras, and scale it to a unit diagonal.

    Nerfies does the same, since the frequency bands of its encodings assume that size.
    Nerfies moves the near plane away from the camera by 25 % (it divides by 0.8). Here
    it moves toward the camera, to half the depth.

    Args:
      points: Scene points in world units, [n, 3].
      positions: Camera positions in world units, [frames, 3].
      depths: z-depths of observations in world units, [observations].

    Returns:
      The placement.
    """
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    inliers = points[distance <= np.quantile(distance, INLIERS)]
    enclosed_points = np.concatenate([inliers, positions])
    low, high = enclosed_points.min(0), enclosed_points.max(0)
    scale = 1 / np.linalg.norm(high - low)
    near, far = np.quantile(depths, QUANTILES) * scale
    return Placement(
        tuple(((low + high) / 2).tolist()),
        float(scale),
        float(near * NEAR_MARGIN),
        float(far * FAR_MARGIN),
    )


def place_by_cameras(cameras: Camera) -> Placement:
    """Estimate the placement from cameras alone, assuming that they look at the scene.

    The scene is centered on the point nearest to all viewing axes. The mean distance of
    the cameras from it becomes 1 scene unit, near is 0.05 and far 4.

    Args:
      cameras: Cameras in world units, [frames].

    Returns:
      The placement.
    """
    axes = np.asarray(cameras.camera_from_world, np.float64)[:, 2]
    positions = np.asarray(cameras.position, np.float64)
    across = across_ray(axes)
    matrix, right = across.sum(0), np.einsum("nij,nj->i", across, positions)
    # Parallel axes have no nearest point. The spread of the cameras sets the size then.
    converging = np.linalg.svd(matrix, compute_uv=False)[-1] > 1e-3 * len(axes)
    spread = np.linalg.norm(positions - positions.mean(0), axis=1).max()
    if converging:
        center = np.linalg.solve(matrix, right)
        distance = np.linalg.norm(positions - center, axis=1).mean()
    else:
        distance = 10 * spread
        center = positions.mean(0) + axes.mean(0) * distance
    # With all cameras at one position (up to rounding) the scale is arbitrary.
    if not distance > SAME_PLACE * np.abs(positions).max():
        distance, center = 1.0, positions.mean(0) + axes.mean(0)
    return Placement(tuple(center.tolist()), float(1 / distance), 0.05, 4.0)


def read_ply(path: pathlib.Path) -> PointCloud:
    """Read a .ply point cloud.

    Args:
      path: The file.

    Returns:
      Positions as stored (float64), and colors, gray if the file has none.

    Raises:
      CaptureError: If it is not such a file, has more than `MAX_POINTS`, or has colors
        that are neither uchar nor floats between 0 and 1.
    """
    try:
        vertex = ply_files.read(path)["vertex"]
        if vertex.count > MAX_POINTS:
            raise CaptureError(
                f"{path}: {vertex.count} points; at most {MAX_POINTS} are read"
            )
        _check_numbers(vertex)
        position = np.stack([vertex[axis] for axis in "xyz"], axis=1)
        names = {each.name for each in vertex.properties}
        if {"red", "green", "blue"} <= names:
            color = np.stack([vertex[k] for k in ("red", "green", "blue")], axis=1)
            color = _bytes(color, path)
        else:
            color = np.full(position.shape, UNSEEN, np.uint8)
    except CaptureError:
        raise
    except (OSError, ValueError, KeyError, TypeError, MemoryError) as error:
        reason = " ".join(str(error).split())
        raise CaptureError(
            f"{path}: not a readable point cloud ({reason}); export it again"
        ) from None
    position = position.astype(np.float64)
    # Later computations are in float32.
    finite = (np.abs(position) <= np.finfo(np.float32).max).all(1)
    return PointCloud(position[finite], color[finite])


def _check_numbers(vertex):
    """Raise ValueError if positions or colors are not scalar properties."""
    names = {"x", "y", "z", "red", "green", "blue"}
    lists = [
        each.name
        for each in vertex.properties
        if each.name in names and vertex.data.dtype[each.name].kind not in "fiu"
    ]
    if lists:
        raise ValueError(f"properties that are not numbers: {', '.join(lists)}")


def _bytes(color, path):
    """Convert colors to uint8, from floats between 0 and 1 if needed."""
    if color.dtype == np.uint8:
        return color
    if color.dtype.kind == "f" and ((color >= 0) & (color <= 1)).all():
        return np.round(color * 255).astype(np.uint8)
    raise CaptureError(
        f"{path}: colors are {color.dtype} from {color.min():g} to "
        f"{color.max():g}; write them as uchar, or as floats between 0 and 1"
    )
