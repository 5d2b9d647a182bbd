"""Dense static points from flow over many frames, for initialization."""

import numpy as np

from nerfies_jax.capture.capture import PointCloud
from nerfies_jax.geometry.rays import across_ray
from nerfies_jax.preprocessing import static_points
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.static_points import StaticPoints
from nerfies_jax.preprocessing.tracks import TRACK_PX, Tracks
from nerfies_jax.preprocessing.view_set import Views

REACH = 8  # frames before and after
CENTERS = 12  # frames whose pixels are triangulated
EVERY_PX = 2
LEAST_FRAMES = 4
MISS_PX = 0.5  # maximum reprojection error in 70 % of the frames
DEPTH_DEVIATION = 0.05  # maximum relative deviation of the depth


def work(views: Views) -> int:
    """Return an upper bound of the work of `dense`.

    Args:
      views: The frames.

    Returns:
      Number of pixels times number of frames.
    """
    frames, (width, height) = len(views.row), views.size
    each = width * height // EVERY_PX**2 * min(2 * REACH + 1, frames)
    return min(CENTERS, frames) * each


def dense(views: Views, flow: NeighborFlow, moving: np.ndarray) -> PointCloud:
    """Triangulate static pixels of some frames whose depth is determined by flow.

    Args:
      views: The frames.
      flow: Their flow.
      moving: True for pixels to exclude, [frames, height, width].

    Returns:
      Positions and colors.
    """
    frames = len(views.row)
    reach = min(REACH, frames - 1)
    centers = np.linspace(0, frames - 1, min(CENTERS, frames)).round().astype(int)
    places, colors = [], []
    for center in np.unique(centers):
        span = slice(max(0, center - reach), min(frames, center + reach + 1))
        near = view_slice(views, span)
        starts = _starts(near, moving[center], center - span.start)
        near_flow = NeighborFlow(*(part[span] for part in flow))
        tracks = without(tracking.chain(near_flow, starts), moving[span])
        enough = tracks.visible.sum(1) >= min(LEAST_FRAMES, reach + 1)
        tracks = tracks.take(enough)
        if not len(tracks.visible):
            continue
        static_fit = static_points.fit(near, tracks)
        valid = _has_depth(near, tracks, static_fit)
        places.append(static_fit.position[valid])
        pixel = starts[enough][valid, 1:].astype(int)
        colors.append(views.image[center][pixel[:, 1], pixel[:, 0]])
    if not places:
        return PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    return PointCloud(np.concatenate(places).astype(np.float32), np.concatenate(colors))


def view_slice(views: Views, span: slice) -> Views:
    """Select consecutive frames.

    Args:
      views: The frames.
      span: The slice.

    Returns:
      The selected frames.
    """
    return Views(*(part[span] for part in views))


def _starts(views, moving, frame):
    width, height = views.size
    x, y = np.meshgrid(
        np.arange(1, width - 1, EVERY_PX), np.arange(1, height - 1, EVERY_PX)
    )
    x, y = x.ravel(), y.ravel()
    is_static = (views.valid[frame] & ~moving)[y, x]
    pixel = np.stack([x, y], -1)[is_static] + 0.5
    return np.concatenate([np.full((len(pixel), 1), frame), pixel], axis=-1)


def without(tracks: Tracks, moving: np.ndarray) -> Tracks:
    """Drop the observations of tracks on moving pixels.

    Args:
      tracks: The tracks.
      moving: True for moving pixels, [frames, height, width].

    Returns:
      The tracks.
    """
    row, column = tracking.pixel_of(tracks.pixel, moving.shape[1:])
    frames = np.arange(len(moving))[None]
    return tracks._replace(visible=tracks.visible & ~moving[frames, row, column])


def _has_depth(views: Views, tracks: Tracks, static_fit: StaticPoints) -> np.ndarray:
    """Test if tracks fit their static point and determine its depth."""
    fits = static_points.miss(static_fit) < MISS_PX
    return fits & (depth_deviation(views, tracks, static_fit) < DEPTH_DEVIATION)


def depth_deviation(
    views: Views, tracks: Tracks, static_fit: StaticPoints
) -> np.ndarray:
    """Compute the relative standard deviation of the distance of static points.

    Args:
      views: The frames.
      tracks: The tracks.
      static_fit: Their static points.

    Returns:
      Deviations relative to the distance [tracks], inf without parallax.
    """
    offset = static_fit.position[:, None] - views.position
    distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-9)
    unit = offset / distance[..., None]
    across = across_ray(unit)
    focal = views.intrinsics[:, 0, 0]
    with np.errstate(divide="ignore"):
        weight = tracks.visible * (focal / (TRACK_PX * distance)) ** 2
    information = np.einsum("nf,nfij->nij", weight, across)
    least = np.linalg.eigvalsh(information)[:, 0]
    typical = (distance * tracks.visible).sum(1) / np.maximum(tracks.visible.sum(1), 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(least > 0, 1 / np.sqrt(np.maximum(least, 0)) / typical, np.inf)
