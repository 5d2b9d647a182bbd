"""Optical flow of large displacements, initialized with the flow of a static scene.

A coarse-to-fine search confuses repetitive patterns, and large displacements are
ambiguous at coarse levels. Several searches are initialized with the flow of static
planes, which follows from the known cameras, and the best match of each pixel is used.
This also helps moving objects, whose search range becomes smaller.
"""

from collections.abc import Callable

import cv2
import numpy as np

from nerfies_jax.preprocessing import view_set
from nerfies_jax.preprocessing.view_set import Views

# Median flow relative to the image width above which a pair is searched again. The
# video of `static` at 112x84 and 40 frames has such displacements. Without another
# search, 6.6 % of its pixels are marked as moving, because the flow of a checkered cube
# has an error of 15 % in each pair.
WIDE_SHARE = 0.03
MOST_TURN_RAD = 0.8  # maximum angle between viewing axes for another search
# Displacement between consecutive planes relative to the width, and maximum number of
# planes. With twice the displacement and at most three planes, 5 % of the pixels of
# that video are marked, with six planes 0.8 %. Initialization with groups of SIFT
# features (RANSAC of similarity transforms) is no better: for every sixth frame of
# `fast`, 79 % of the moving points are lost with and without.
STEP_SHARE, MOST_PLANES = 0.03, 6
WINDOW_SHARE = 0.023  # standard deviation of the matching window relative to the width
OWN = 0.9  # maximum cost of another search relative to that of the first

Search = Callable[..., np.ndarray]  # flow between two frames from an initial flow


def is_wide(views: Views, pair: tuple[int, int], flow: np.ndarray) -> bool:
    """Test if the flow of a pair of frames should be searched for again.

    Args:
      views: The frames.
      pair: Indices of the two frames.
      flow: Flow in pixels, [height, width, 2].

    Returns:
      True for large displacements.
    """
    first, second = (views.rotation[index, 2] for index in pair)
    if first @ second < np.cos(MOST_TURN_RAD):
        return False
    length = np.linalg.norm(flow[::4, ::4], axis=-1)
    return float(np.median(length)) > WIDE_SHARE * flow.shape[1]


def improved(
    views: Views,
    images: tuple[np.ndarray, np.ndarray],
    pair: tuple[int, int],
    flow: np.ndarray,
    search: Search,
    span: tuple[float, float],
) -> np.ndarray:
    """Combine the flow of several searches by the similarity around each pixel.

    Args:
      views: The frames.
      images: Images of the pair, in the pixels of the views.
      pair: Indices of the two frames.
      flow: Flow of the first search, [height, width, 2].
      search: Search from an initial flow.
      span: Nearest and farthest z-depth in scene units.

    Returns:
      Flow in pixels, [height, width, 2].
    """
    near, far = (_plane_flow(views, pair, depth) for depth in span)
    distance = float(np.median(np.linalg.norm(near - far, axis=-1)))
    count = int(
        np.clip(np.ceil(distance / (STEP_SHARE * flow.shape[1])), 1, MOST_PLANES)
    )
    share = (np.arange(count) + 0.5) / count
    inverse = share / span[0] + (1 - share) / span[1]
    best, lowest = flow.copy(), OWN * unlike(images, flow)
    for depth in 1 / inverse:
        candidate = search(_plane_flow(views, pair, depth))
        cost = unlike(images, candidate)
        better = cost < lowest
        best[better], lowest[better] = candidate[better], cost[better]
    return best


def _plane_flow(views: Views, pair: tuple[int, int], depth: float) -> np.ndarray:
    """Compute the flow of a static plane at a z-depth of the first frame."""
    one, other = pair
    width, height = views.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    point = views.position[one] + depth * view_set.rays(views, one)
    pixel, ahead = view_set.project(views, other, point.reshape(-1, 3))
    shift = pixel.reshape(height, width, 2) - np.stack([x, y], -1)
    behind = (ahead <= 0).reshape(height, width)
    # The initial flow of points behind the camera is arbitrary.
    return np.where(behind[..., None], 0, np.clip(shift, -width, width)).astype(
        np.float32
    )


def unlike(images, flow):
    """Compute the mean color difference around each pixel along the flow.

    Args:
      images: Images of the pair, [height, width].
      flow: Flow in pixels, [height, width, 2].

    Returns:
      Differences in gray levels, [height, width].
    """
    first, second = images
    height, width = first.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height))
    at = x + flow[..., 0], y.astype(np.float32) + flow[..., 1]
    # Positions outside of the image have a large difference.
    image = cv2.remap(np.float32(second), *at, cv2.INTER_LINEAR, borderValue=-255)
    return cv2.GaussianBlur(np.abs(first - image), (0, 0), WINDOW_SHARE * width)
