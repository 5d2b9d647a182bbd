"""Static points that fit tracks best, and their reprojection errors."""

from typing import NamedTuple

import numpy as np

from nerfies_jax.geometry.rays import across_ray
from nerfies_jax.preprocessing import view_set
from nerfies_jax.preprocessing.tracks import Tracks, joined
from nerfies_jax.preprocessing.view_set import Views

ROUNDS = 4  # of reweighting, because the error in pixels depends on the depth
FAR_AWAY = 10.0  # depth without parallax, as a multiple of the extent of the cameras
BEHIND_PX = 1e4  # error of a point behind the camera
QUANTILE = 0.7  # of the reprojection errors of a track over its frames
LEAST_DEPTH = 1e-3  # scene units, only for weights
AT_ONCE = 2048  # tracks, at 200 bytes for each track and frame


class StaticPoints(NamedTuple):
    """One static point for each track."""

    position: np.ndarray  # [tracks, 3] scene units
    residual: np.ndarray  # [tracks, frames] px, NaN if the track is not visible
    depth: np.ndarray  # [tracks, frames] z-depth of the point

    def take(self, which: np.ndarray) -> "StaticPoints":
        """Select points.

        Args:
          which: Indices or mask.

        Returns:
          The selected points.
        """
        return StaticPoints(*(part[which] for part in self))


def track_rays(views: Views, tracks: Tracks) -> np.ndarray:
    """Compute the world directions of tracks, scaled to z-depth one.

    Args:
      views: The frames.
      tracks: The tracks.

    Returns:
      Directions, [tracks, frames, 3].
    """
    pixel = tracks.pixel.astype(np.float64)
    ones = np.ones((*pixel.shape[:2], 1))
    inverse = np.linalg.inv(views.intrinsics)
    local = np.einsum("fij,nfj->nfi", inverse, np.concatenate([pixel, ones], -1))
    return np.einsum("fji,nfj->nfi", views.rotation, local)


def fit(views: Views, tracks: Tracks) -> StaticPoints:
    """Fit static points by least squares of distances to rays over depth squared.

    This is nearly the reprojection error in pixels.

    Args:
      views: The frames.
      tracks: The tracks.

    Returns:
      One point for each track.
    """
    count = len(tracks.visible)
    blocks = np.split(np.arange(count), range(AT_ONCE, count, AT_ONCE))
    return joined([_fit(views, tracks.take(block)) for block in blocks])


def _fit(views, tracks):
    ray = track_rays(views, tracks)
    unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    across = across_ray(unit)
    weight = tracks.visible.astype(np.float64)
    # For parallel rays, any depth in front of the cameras fits.
    baseline = np.linalg.norm(np.ptp(views.position, axis=0))
    ahead = views.position + (FAR_AWAY * baseline if baseline > 0 else 1.0) * unit
    count = np.maximum(tracks.visible.sum(1), 1)[:, None]
    ahead = (ahead * tracks.visible[..., None]).sum(1) / count
    for _ in range(ROUNDS):
        matrix = np.einsum("nf,nfij->nij", weight, across)
        ridge = 1e-9 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] + 1e-30
        right = np.einsum("nf,nfij,fj->ni", weight, across, views.position)
        right = right + ridge[:, :, 0] * ahead
        matrix = matrix + ridge * np.eye(3)
        position = np.linalg.solve(matrix, right[..., None])[..., 0]
        far = np.linalg.norm(position[:, None] - views.position, axis=-1)
        weight = tracks.visible / np.maximum(far, LEAST_DEPTH) ** 2
    residual = np.full(tracks.visible.shape, np.nan)
    depth = np.zeros(tracks.visible.shape)
    for frame in range(len(views.row)):
        pixel, depth[:, frame] = view_set.project(views, frame, position)
        miss = np.linalg.norm(pixel - tracks.pixel[:, frame], axis=-1)
        miss = np.where(depth[:, frame] > 0, miss, BEHIND_PX)
        residual[:, frame] = np.where(tracks.visible[:, frame], miss, np.nan)
    return StaticPoints(position, residual, depth)


def miss(rest: StaticPoints) -> np.ndarray:
    """Compute the 70 % quantile over frames of the reprojection error of each track.

    Args:
      rest: Static points.

    Returns:
      Errors in pixels, [tracks].
    """
    # Faster than nanquantile of NumPy, which takes 2 s for a video of 60 frames.
    order = np.sort(rest.residual, axis=1)  # NaN is last
    place = QUANTILE * (np.isfinite(rest.residual).sum(1) - 1)
    low = np.maximum(np.floor(place).astype(int), 0)
    high = np.minimum(low + 1, np.maximum(np.ceil(place).astype(int), 0))
    each = np.arange(len(order))
    part = place - low
    return (1 - part) * order[each, low] + part * order[each, high]
