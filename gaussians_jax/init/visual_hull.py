"""Initial points in the visual hull of a static object in front of a known background.

Laurentini 1994, "The visual hull concept for silhouette-based image understanding".
"""

import jax
import numpy as np
import scipy.ndimage

from gaussians_jax.core import splats
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry.camera import project

BATCH, MAX_BATCHES = 50_000, 40  # candidates tested together, and their most batches
MAX_VIEWS = 100  # of more views, evenly spaced ones are used
SAME_COLOR = 2  # largest deviation of a background pixel, of 255
MARGIN_PX = 1  # by which silhouettes are widened, because their edges are mixed pixels
# Share of pixels in front of the background. With less there is nothing to see, and
# with more the background is not a background.
MIN_FOREGROUND, MAX_FOREGROUND = 0.005, 0.9


# One function for all batches of candidates, which is compiled once.
_in_view = jax.jit(jax.vmap(project, (None, 0)))


def hull_points(
    rng: np.random.Generator,
    capture: Capture,
    count: int,
    span: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray] | None:
    """Sample points that project into the silhouettes of all training views.

    Args:
      rng: Random generator.
      capture: The capture.
      count: Number of points.
      span: Smallest and largest z-depth of the points in scene units.

    Returns:
      Positions [count, 3] in scene units and their mean colors [count, 3] in [0, 1], or
      None without a hull: the background is unknown, there are several timestamps, or
      the silhouettes have no common volume.
    """
    rows = capture.train
    if capture.background is None or np.ptp(capture.times[rows]) > 0:
        return None
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MAX_VIEWS)).astype(int)]
    masks = _silhouettes(capture, rows)
    if not MIN_FOREGROUND <= masks.mean() <= MAX_FOREGROUND:
        return None
    cameras = jax.tree.map(lambda leaf: leaf[rows], capture.cameras)
    parts, total = [], 0
    for _ in range(MAX_BATCHES):
        points = splats.random_in_views(rng, cameras, capture.size, *span, BATCH)
        parts.append(_inside(points, cameras, capture.images[rows], masks))
        total += len(parts[-1][0])
        if not total:
            return None  # less than one in `BATCH` candidates
        if total >= count:
            break
    if total < count:
        return None
    positions, colors = zip(*parts, strict=True)
    return np.concatenate(positions)[:count], np.concatenate(colors)[:count]


def _silhouettes(capture, rows):
    """Find the pixels that differ from the background or are masked, widened."""
    background = np.round(255 * np.asarray(capture.background)).astype(np.int16)
    difference = np.abs(capture.images[rows].astype(np.int16) - background)
    masks = difference.max(-1) > SAME_COLOR
    if capture.valid is not None:
        masks |= ~capture.valid[rows]
    side = 2 * MARGIN_PX + 1
    return scipy.ndimage.binary_dilation(masks, np.ones((1, side, side), bool))


def _inside(points, cameras, images, masks):
    """Select the points inside of all silhouettes, with their mean colors.

    A view does not constrain points outside of its image.
    """
    height, width = masks.shape[1:]
    color, views = np.zeros((len(points), 3)), np.zeros((len(points), 1))
    # All arrays have the first number of points, so that `_in_view` compiles once.
    rows = np.arange(len(points))
    for row, (image, mask) in enumerate(zip(images, masks, strict=True)):
        camera = jax.tree.map(lambda leaf, row=row: leaf[row], cameras)
        padded_points = np.zeros(points.shape, np.float32)
        padded_points[: len(rows)] = points[rows]
        pixel, depth = (
            np.asarray(x)[: len(rows)] for x in _in_view(camera, padded_points)
        )
        in_image = (depth > 0) & np.all(
            (pixel >= 0) & (pixel < (width, height)), axis=1
        )
        column, line = np.where(in_image[:, None], pixel, 0).astype(int).T
        color[rows] += np.where(in_image[:, None], image[line, column] / 255, 0)
        views[rows] += in_image[:, None]
        rows = rows[~in_image | mask[line, column]]
    rows = rows[views[rows, 0] > 0]
    return points[rows], color[rows] / views[rows]
