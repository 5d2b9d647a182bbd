"""Errors of preprocessing against the ground truth of a synthetic scene.

Ground truth points are tracked from the frame in which they are first visible by the
computed flow, realigned, and reconstructed in 3D, like the tracks of preprocessing.
"""

from typing import NamedTuple

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.synthetic import SceneTruth
from nerfies_jax.capture.synthetic import truth as truths
from nerfies_jax.preprocessing import dense_flow, paths, record, short_tracks, view_set
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.record import Evidence
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.usable_paths import scene_unit

LATER = 24  # frames after which a track is compared with the ground truth


class TruePoints(NamedTuple):
    """Moving points, in the frames and pixels of preprocessing."""

    pixel: np.ndarray  # [points, frames, 2]
    visible: np.ndarray  # [points, frames] bool
    position: np.ndarray  # [points, frames, 3] scene units


class Errors(NamedTuple):
    """Errors of masks, tracks and paths, NaN if there is nothing to measure."""

    mask_iou: float  # of moving pixels
    false_share: float  # share of all pixels that are static but marked as moving
    track_px: float  # median after `LATER` frames
    track_lost: float  # share of lost tracks among the points visible then
    path_error: float  # median, relative to the scene distance


def true_points(capture: Capture, truth: SceneTruth, evidence: Evidence) -> TruePoints:
    """Return the moving points of the ground truth.

    Args:
      capture: The capture.
      truth: Its ground truth.
      evidence: Its preprocessing, which determines frames and pixels.

    Returns:
      The points.

    Raises:
      ValueError: If the ground truth belongs to another capture.
    """
    position = truths.track_places(capture, truth, evidence.row)
    scale = evidence.moving.shape[2] / truth.things.shape[2]
    return TruePoints(
        truth.track_pixel[:, evidence.row] * scale,
        truth.track_seen[:, evidence.row],
        position,
    )


def errors(capture: Capture, evidence: Evidence, points: TruePoints) -> Errors:
    """Compute the errors of masks, tracks and paths.

    Args:
      capture: The capture with its true masks of moving pixels.
      evidence: Its preprocessing.
      points: Ground truth points.

    Returns:
      The errors.
    """
    small = record.downscale(capture, evidence.factor)
    assert small.moving is not None
    true = small.moving[evidence.row]
    union = (evidence.moving | true).sum()
    iou = (evidence.moving & true).sum() / union if true.any() else np.nan
    track_px = lost_share = path_error = np.nan
    rows = np.flatnonzero(points.visible.any(1))
    if len(rows):
        points = TruePoints(*(part[rows] for part in points))
        views = view_set.in_time_order(small)
        tracks = _tracks_of(views, evidence, points)
        track_px, lost_share = _track_error(tracks, points)
        path_error = _path_error(capture, views, evidence, tracks, points)
    return Errors(
        mask_iou=float(iou),
        false_share=float((evidence.moving & ~true).mean()),
        track_px=track_px,
        track_lost=lost_share,
        path_error=path_error,
    )


def _tracks_of(views, evidence, points):
    start = points.visible.argmax(1)
    place = points.pixel[np.arange(len(start)), start]
    starts = np.concatenate([start[:, None], place], axis=1)
    tracks = tracking.chain(evidence.flow, starts)
    return tracking.realigned(tracks, dense_flow.leveled(views), views.size)


def _track_error(tracks: Tracks, points):
    later = tracks.start + LATER
    rows = np.flatnonzero(later < points.visible.shape[1])
    rows = rows[points.visible[rows, later[rows]]]
    if not len(rows):
        return np.nan, np.nan
    visible_rows = rows[tracks.visible[rows, later[rows]]]
    offset = (
        tracks.pixel[visible_rows, later[visible_rows]]
        - points.pixel[visible_rows, later[visible_rows]]
    )
    error = np.linalg.norm(offset, axis=-1)
    median = float(np.median(error)) if len(error) else np.nan
    return median, 1 - len(visible_rows) / len(rows)


def _path_error(capture, views, evidence, tracks, points):
    long = tracks.visible.sum(1) >= min(short_tracks.USUAL.path, len(views.row))
    tracks = tracks.take(long)
    if not long.any():
        return np.nan
    static = evidence.score < paths.STATIC_SCORE
    around = paths.depth_around(
        tracks,
        evidence.tracks.take(static),
        evidence.static_fit.take(static),
        capture.near,
    )
    solution = paths.least_acceleration(views, tracks, capture.near, around)
    error = np.linalg.norm(solution.position - points.position[long], axis=-1)
    valid = solution.known & points.visible[long]
    if not valid.any():
        return np.nan
    return float(np.median(error[valid]) / scene_unit(evidence))
