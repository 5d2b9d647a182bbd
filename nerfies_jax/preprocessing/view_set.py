"""Frames of a capture for preprocessing: reduced, in temporal order, in NumPy."""

import math
from typing import NamedTuple

import cv2
import numpy as np
import scipy.ndimage as nd

from nerfies_jax.capture.capture import Capture

LONGEST_SIDE_PX = 256  # of reduced images, for results that need no full resolution
PLAIN_SHARE = 0.9  # minimum share of border pixels of a uniform background
PLAIN_LEVELS = 3  # of 255, the noise of a uniform color due to JPEG and rounding
MIN_POINTS = 300  # for the depth range of a scene
MOST_POINTS = 4000  # that are used
OUTSIDE = 0.02  # share of outliers at each end of the depth range
# Minimum gradient in gray levels per pixel, its minimum ratio to that of noise, and the
# share of noise that a Gaussian derivative of 1 px passes. For smaller gradients, flow
# is determined by its regularizer.
LEAST_GRADIENT, LEAST_OVER_NOISE, NOISE_PASSED = 0.4, 3.0, 0.2
# Gray levels. Detail of a lawn, which is everywhere, would otherwise be considered as
# noise: 12 to 15 levels in grass and gravel of scikit-image, downsampled four times.
MOST_NOISE = 6.0


class Views(NamedTuple):
    """Training frames with pinhole cameras in float64.

    Pixels are those of the reduced images, with centers at +0.5.
    """

    row: np.ndarray  # [frames] row of the capture
    camera: np.ndarray  # [frames] which physical camera
    time: np.ndarray  # [frames] in [0, 1]
    image: np.ndarray  # [frames, height, width, 3] uint8 sRGB
    gray: np.ndarray  # [frames, height, width] float32 in [0, 1]
    valid: np.ndarray  # [frames, height, width] bool: no black border or plain color
    textured: np.ndarray  # [frames, height, width] bool: flow can be determined
    intrinsics: np.ndarray  # [frames, 3, 3]: pixel ~ K @ point in camera
    rotation: np.ndarray  # [frames, 3, 3] camera_from_world
    position: np.ndarray  # [frames, 3] scene units

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.gray.shape[2], self.gray.shape[1]

    def depth_of(self, position: np.ndarray) -> np.ndarray:
        """Compute the z-depths of points.

        Args:
          position: Positions in scene units, [points, frames, 3].

        Returns:
          z-depths in scene units, [points, frames].
        """
        offset = position - self.position
        return np.einsum("fj,nfj->nf", self.rotation[:, 2], offset)


def in_time_order(capture: Capture, rows: np.ndarray | None = None) -> Views:
    """Return training frames of all cameras in temporal order.

    Args:
      capture: The capture.
      rows: Indices of other frames. None for the training frames.

    Returns:
      The frames.
    """
    rows = capture.train if rows is None else rows
    return _views(capture, rows[np.lexsort((rows, capture.times[rows]))])


def without_cameras(images: np.ndarray) -> Views:
    """Return frames without cameras, whose parameters are NaN.

    Args:
      images: uint8 images in order of time, [frames, height, width, 3].

    Returns:
      The frames.
    """
    frames, height, width = images.shape[:3]
    gray = _gray(images)
    unknown = np.full((frames, 3, 3), np.nan)
    return Views(
        row=np.arange(frames),
        camera=np.zeros(frames, int),
        time=np.linspace(0, 1, frames),
        image=images,
        gray=gray,
        valid=np.ones((frames, height, width), bool),
        textured=np.stack([_find_texture(frame) for frame in gray]),
        intrinsics=unknown,
        rotation=unknown,
        position=unknown[:, 0],
    )


def _gray(images):
    """Return the mean of the channels in [0, 1], float32, one image at a time."""
    gray = np.empty(images.shape[:3], np.float32)
    for row, image in enumerate(images):
        gray[row] = image.mean(-1) / 255
    return gray


def _views(capture, rows):
    image = capture.images[rows]
    gray = _gray(image)
    valid = ~plain(capture, rows)
    if capture.valid is not None:
        # Resampled pixels at the edge of a black corner are half black.
        valid &= nd.binary_erosion(
            capture.valid[rows], np.ones((1, 5, 5)), border_value=1
        )
    cameras = capture.cameras
    return Views(
        row=rows,
        camera=capture.camera_ids[rows],
        time=capture.times[rows].astype(np.float64),
        image=image,
        gray=gray,
        valid=valid,
        textured=valid & np.stack([_find_texture(frame) for frame in gray]),
        intrinsics=np.stack([_matrix(cameras, row) for row in rows]),
        rotation=cameras.camera_from_world[rows].astype(np.float64),
        position=cameras.position[rows].astype(np.float64),
    )


def smaller(views: Views, factor: int) -> Views:
    """Reduce frames by an integer factor. Incomplete blocks at the border are dropped.

    Args:
      views: The frames.
      factor: Integer factor.

    Returns:
      The reduced frames.
    """
    if factor == 1:
        return views
    width, height = (side // factor for side in views.size)
    crop = np.s_[:, : height * factor, : width * factor]

    def shrink(images):
        parts = [
            cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
            for image in images[crop]
        ]
        return np.stack(parts)

    scale = np.diag([1 / factor, 1 / factor, 1.0])
    return views._replace(
        image=shrink(views.image),
        gray=shrink(views.gray),
        valid=shrink(np.uint8(views.valid)) > 0,
        textured=shrink(np.uint8(views.textured)) > 0,
        intrinsics=scale @ views.intrinsics,
    )


def times_smaller(views: Views) -> int:
    """Return the reduction at which no side is longer than `LONGEST_SIDE_PX`.

    Args:
      views: The frames.

    Returns:
      An integer factor.
    """
    return math.ceil(max(views.size) / LONGEST_SIDE_PX)


def plain(capture: Capture, rows: np.ndarray) -> np.ndarray:
    """Find pixels that show a uniform background color.

    It is the median color of the border, if nearly all of the border has this color. A
    plain wall in a part of the border belongs to the scene.

    Args:
      capture: The capture.
      rows: Indices of the frames.

    Returns:
      Booleans, [rows, height, width].
    """
    images = capture.images[rows]
    border = np.concatenate(
        [images[:, 0], images[:, -1], images[:, :, 0], images[:, :, -1]], axis=1
    )
    color = np.median(border.reshape(-1, 3), axis=0)

    def near(pixels):
        return (np.abs(pixels - color) <= PLAIN_LEVELS).all(-1)

    if near(border).mean() < PLAIN_SHARE:
        return np.zeros(images.shape[:3], bool)
    behind = near(images.astype(np.float32))
    # Only regions connected to the border, not black spots of an object.
    result = np.zeros_like(behind)
    for row, mask in enumerate(behind):
        seeds = np.zeros_like(mask)
        seeds[[0, -1]], seeds[:, [0, -1]] = True, True
        result[row] = nd.binary_propagation(seeds & mask, mask=mask)
    return result


def rays(views: Views, index: int) -> np.ndarray:
    """Compute the world directions of all pixel centers, scaled to z-depth one.

    Args:
      views: The frames.
      index: Index of the frame.

    Returns:
      Directions, [height, width, 3].
    """
    width, height = views.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixel = np.stack([x, y, np.ones_like(x)], axis=-1)
    inverse = np.linalg.inv(views.intrinsics[index])
    return pixel @ inverse.T @ views.rotation[index]


def project(
    views: Views, index: int, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Project points into one frame.

    Args:
      views: The frames.
      index: Index of the frame.
      points: Points in scene units, [points, 3].

    Returns:
      Pixel positions [points, 2] and z-depths [points].
    """
    inside = (points - views.position[index]) @ views.rotation[index].T
    depth = inside[:, 2]
    pixel = inside @ views.intrinsics[index].T
    with np.errstate(divide="ignore", invalid="ignore"):
        return pixel[:, :2] / pixel[:, 2:], depth


def in_image(
    views: Views, pixel: np.ndarray, depth: np.ndarray, rim: float | int = 1.0
):
    """Find the positions in front of the camera and inside the image.

    Args:
      views: The frames.
      pixel: Pixel positions, [points, 2].
      depth: z-depths, [points].
      rim: Least distance from the border of the image in pixels.

    Returns:
      Booleans, [points].
    """
    bounds = np.array(views.size) - rim
    with np.errstate(invalid="ignore"):
        return (depth > 0) & ((pixel > rim) & (pixel < bounds)).all(-1)


def own_points(capture: Capture) -> np.ndarray:
    """Return at most `MOST_POINTS` of the capture's points.

    Args:
      capture: The capture.

    Returns:
      Points in scene units [points, 3], empty if there are none.
    """
    if capture.points is None:
        return np.zeros((0, 3))
    return some(capture.points.position)


def some(position: np.ndarray) -> np.ndarray:
    """Select at most `MOST_POINTS` points at random.

    Args:
      position: Points, [points, 3].

    Returns:
      float64 points, [selected, 3].
    """
    position = position.astype(np.float64)
    rng = np.random.default_rng(0)
    if len(position) > MOST_POINTS:
        which = rng.choice(len(position), MOST_POINTS, replace=False)
        position = position[np.sort(which)]
    return position


def depth_span(capture: Capture, views: Views) -> tuple[float, float]:
    """Estimate the z-depth range of a scene from its points or the near and far planes.

    Args:
      capture: The capture.
      views: Its frames.

    Returns:
      Nearest and farthest z-depth in scene units.
    """
    points = own_points(capture)
    if len(points) < MIN_POINTS:
        return capture.near, capture.far
    depths = []
    for index in range(len(views.row)):
        pixel, depth = project(views, index, points)
        depths.append(depth[in_image(views, pixel, depth)])
    depth = np.concatenate(depths)
    if not len(depth):
        return capture.near, capture.far
    low, high = np.quantile(depth, (OUTSIDE, 1 - OUTSIDE))
    # Moving objects are in front of the points of structure from motion.
    return max(capture.near, 0.5 * float(low)), 1.2 * float(high)


def _matrix(cameras, row):
    focal = float(cameras.focal_px[row])
    x, y = cameras.principal_point_px[row]
    return np.array(
        [
            [focal, cameras.skew_px[row], x],
            [0, focal * cameras.pixel_aspect[row], y],
            [0, 0, 1],
        ],
        np.float64,
    )


def _find_texture(gray):
    """Find pixels that vary in every direction, so that there is no aperture problem.

    The criterion is the smaller eigenvalue of the structure tensor over 2 px.
    """
    down, across = (nd.gaussian_filter(gray, 1, order) for order in ((1, 0), (0, 1)))
    xx, yy, xy = (
        nd.gaussian_filter(product, 2)
        for product in (across * across, down * down, across * down)
    )
    half = (xx + yy) / 2
    least = half - np.sqrt(np.maximum(half**2 - (xx * yy - xy**2), 0))
    # Immerkaer 1996: the Laplacian of an image without curvature contains only noise.
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]])
    # The lower quartile (0.3186 deviations), which is affected least by detail.
    noise = np.quantile(np.abs(nd.convolve(gray, mask)), 0.25) / (6 * 0.3186)
    noise = min(noise, MOST_NOISE / 255)
    bound = max(LEAST_GRADIENT / 255, LEAST_OVER_NOISE * NOISE_PASSED * noise)
    return least > bound**2
