"""Dissimilarity of each pixel to the static scene in other frames.

The depth of static regions is computed from static points, and behind moving objects
from the points around. A static pixel has the same color in most other frames, even if
its neighbors move. A moving pixel does not.
"""

import cv2
import numpy as np
import scipy.ndimage as nd

from nerfies_jax.capture.capture import PointCloud
from nerfies_jax.preprocessing import view_set
from nerfies_jax.preprocessing.view_set import Views

OTHERS = (3, 6, 10, 15, 22, 30)  # distances to other frames, before and after
# Quantile of the differences over other frames. In the frames with larger differences
# the point may be occluded by moving objects.
QUANTILE, LEAST_FRAMES = 0.3, 3
BLUR_PX = 0.7
CELL = 2  # side in pixels of cells with one depth
NEARER = 0.9  # relative depth of a neighbor that fills gaps in a surface
HIDDEN = 0.93  # relative depth in the other frame below which the point is occluded
# Difference with even odds, relative to the spread of colors of the video, plus the
# gradient of the image, because positions are not exact.
EVEN, EVEN_SLOPE = 0.5, 0.25
STEEPNESS, MOST = 2.0, 3.0  # of log odds
OUTSIDE = (np.nan,) * 3


def log_odds(views: Views, static_cloud: PointCloud) -> np.ndarray:
    """Compute the log odds that a pixel moves, from colors.

    Args:
      views: The frames.
      static_cloud: Static points, none of them near pixels that may move.

    Returns:
      Log odds [frames, height, width], 0 if unknown.
    """
    frames = len(views.row)
    if not len(static_cloud.position):
        return np.zeros(views.gray.shape, np.float32)
    color, spread = _normalize(views)
    depth = [
        _depth(views, frame, static_cloud.position.astype(float))
        for frame in range(frames)
    ]
    all_odds = np.zeros(views.gray.shape, np.float32)
    for frame in range(frames):
        unlike = _unlike(views, color, depth, frame)
        slope = _slope(color[frame])
        even = EVEN * spread + EVEN_SLOPE * slope
        with np.errstate(invalid="ignore"):
            odds = STEEPNESS * np.log((unlike + 1) / (even + 1))
        all_odds[frame] = np.clip(np.nan_to_num(odds, nan=0.0), -MOST, MOST)
    return all_odds


def _normalize(views):
    """Return blurred images normalized to one mean and spread, and that spread."""
    image = views.image.astype(np.float32)
    mean, spread = image.mean((1, 2)), np.maximum(image.std((1, 2)), 1e-3)
    typical = np.median(spread, axis=0)
    gain = (typical / spread)[:, None, None]
    alike = (image - mean[:, None, None]) * gain + np.median(mean, axis=0)
    blurred_images = [cv2.GaussianBlur(frame, (0, 0), BLUR_PX) for frame in alike]
    return np.stack(blurred_images), float(typical.mean())


def _slope(color):
    """Return the maximum gradient around each pixel, in gray levels per pixel."""
    gray = color.mean(-1)
    across, down = (
        cv2.Sobel(gray, cv2.CV_32F, *by, scale=1 / 8) for by in ((1, 0), (0, 1))
    )
    return cv2.dilate(np.hypot(across, down), np.ones((3, 3)))


def _depth(views, frame, position):
    """Return the z-depth [height, width] of the static scene, with gaps filled.

    It is None if no point is in the image.
    """
    width, height = views.size
    columns, rows = -(-width // CELL), -(-height // CELL)
    pixel, depth = view_set.project(views, frame, position)
    inside = view_set.in_image(views, pixel, depth, 0.0)
    if not inside.any():
        return None
    column, row = (pixel[inside] / CELL).astype(int).T
    nearest = np.full(rows * columns, np.inf)
    np.minimum.at(nearest, row * columns + column, depth[inside])
    nearest = nearest.reshape(rows, columns)
    near = nd.minimum_filter(nearest, 3)
    nearest = np.where(NEARER * nearest > near, near, nearest)
    gap = ~np.isfinite(nearest)
    row, column = nd.distance_transform_edt(
        gap, return_distances=False, return_indices=True
    )
    nearest = nearest[row, column].astype(np.float32).repeat(CELL, 0).repeat(CELL, 1)
    return np.ascontiguousarray(nearest[:height, :width])


def _unlike(views, color, depth, frame):
    """Return the dissimilarity [height, width] in gray levels, NaN if unknown."""
    width, height = views.size
    blank = np.full((height, width), np.nan, np.float32)
    if depth[frame] is None:
        return blank
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixel = np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
    far = depth[frame].reshape(-1)
    differences = []
    for other in (frame + sign * off for off in OTHERS for sign in (-1, 1)):
        if not 0 <= other < len(depth) or depth[other] is None:
            continue
        x, y, z = _places(views, frame, other, pixel, far).reshape(3, height, width)
        there = cv2.remap(color[other], x, y, cv2.INTER_LINEAR, borderValue=OUTSIDE)
        before = cv2.remap(depth[other], x, y, cv2.INTER_NEAREST, borderValue=0)
        red, green, blue = np.moveaxis(np.abs(there - color[frame]), -1, 0)
        unlike = np.maximum(np.maximum(red, green), blue)
        unlike[(z <= 0) | (before < HIDDEN * z)] = np.nan
        differences.append(unlike)
    if len(differences) < LEAST_FRAMES:
        return blank
    order = np.sort(differences, axis=0)  # NaN is last
    count = np.isfinite(order).sum(0)
    place = np.floor(QUANTILE * np.maximum(count - 1, 0)).astype(int)
    quantile = np.take_along_axis(order, place[None], axis=0)[0]
    return np.where(count >= LEAST_FRAMES, quantile, np.nan)


def _places(views, frame, other, pixel, depth):
    """Return pixel positions for OpenCV in another frame and z-depths, [3, pixels]."""
    turn = views.intrinsics[other] @ views.rotation[other]
    back = views.rotation[frame].T @ np.linalg.inv(views.intrinsics[frame])
    shift = turn @ (views.position[frame] - views.position[other])
    place = (turn @ back) @ pixel * depth + shift[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        place[:2] = place[:2] / place[2] - 0.5
    return place.astype(np.float32)
