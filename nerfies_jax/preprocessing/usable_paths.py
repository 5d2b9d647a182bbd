"""Selection of 3D paths for the initialization of motion."""

import warnings
from typing import NamedTuple

import cv2
import numpy as np

from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
from nerfies_jax.preprocessing import record
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.moving import image_scale
from nerfies_jax.preprocessing.record import Evidence
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.training.track_start import TrackStartSpec

# Minimum share of the moving pixels of all frames that have a known path near them.
# With less, most of what moves would have a motion that nothing determines.
LEAST_COVERAGE = 0.1
NEAR_PX = 8.0  # at a width of 176 px, more in larger images
LEAST_MOVING = 0.005  # of the pixels. In static videos, up to 0.4 % are marked.
# Of the pixels. Above the first, something may move even if no path is known, unless
# hardly any of `LEAST_TRACKS` tracks or more moves. Above the second, something moves.
MARKED, MOST_MARKED = 0.01, 0.1
LEAST_TRACKS = 100
FALSE_SHARE = 0.001  # of the tracks. Static built-in scenes have 0.03 % that move.


class KnownPaths(NamedTuple):
    """Positions of moving points over the frames of preprocessing."""

    position: np.ndarray  # [paths, frames, 3] scene units, arbitrary if not known
    known: np.ndarray  # [paths, frames] bool
    depth_deviation: np.ndarray  # [paths] relative to the depth
    is_rigid: np.ndarray  # [paths] bool, on a rigid object
    tracks: Tracks  # [paths]


def evidence_to_start_from(capture: Capture, start: TrackStartSpec) -> Evidence | None:
    """Preprocess a capture for the initialization of motion, or read it from the cache.

    Args:
      capture: The capture.
      start: Settings of the initialization.

    Returns:
      The results. None if `start` does not request tracks, or if they are unusable,
      which a warning reports.
    """
    if start.motion != "tracks":
        return None
    evidence = record.cached(capture, CACHE / "evidence", start.use_depths)
    reason = unusable(evidence)
    if not reason:
        return evidence
    warnings.warn(
        f"{capture.path or capture.name}: the motion is initialized as static, because "
        f"tracks cannot be used: {reason}; motion of more than a few pixels may not be "
        "learned. start.motion=none restores the schedule of the preset without tracks",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def unusable(evidence: Evidence) -> str:
    """Return the reason why motion cannot be initialized from tracks.

    Args:
      evidence: Preprocessing.

    Returns:
      The reason, empty if it can.
    """
    if evidence.unusable:
        return evidence.unusable
    if not evidence.is_external and evidence.moving.mean() < LEAST_MOVING:
        return f"only {evidence.moving.mean():.1%} of the pixels show moving objects"
    share = coverage(evidence)
    if share < LEAST_COVERAGE:
        return (
            f"only {share:.0%} of the moving pixels are near a track that is long "
            f"enough to fit a motion (at least {LEAST_COVERAGE:.0%} are needed)"
        )
    return ""


def coverage(evidence: Evidence) -> float:
    """Compute the share of moving pixels, over all frames, near a known path.

    A path covers pixels only in frames in which it is known, so the share also measures
    the part of the time that paths are known.

    Args:
      evidence: Preprocessing.

    Returns:
      The share, 0 if nothing moves.
    """
    usable = _is_known(evidence)
    pixel = evidence.path_tracks.pixel[usable]
    valid = evidence.paths.known[usable]
    shape = evidence.moving.shape[1:]
    reach, near = NEAR_PX * image_scale(shape[1]), 0
    for frame in np.flatnonzero(valid.any(0)):
        away = np.ones(shape, np.uint8)
        away[tracking.pixel_of(pixel[valid[:, frame], frame], shape)] = 0
        distance = cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        near += int((evidence.moving[frame] & (distance <= reach)).sum())
    return near / max(int(evidence.moving.sum()), 1)


def _is_known(evidence):
    """Find the paths that are known in enough frames."""
    return evidence.paths.known.sum(1) >= evidence.least_known


def is_static(evidence: Evidence, times: np.ndarray) -> bool:
    """Test if the scene is static: it has a single time, or only static tracks.

    Args:
      evidence: Preprocessing.
      times: Times of all frames of the capture, [frames].

    Returns:
      True for a static scene.
    """
    if np.ptp(times[evidence.row]) == 0:
        return True
    if evidence.is_external or evidence.unusable or not unusable(evidence):
        return False
    moving_share = float(evidence.moving.mean())
    if moving_share < MARKED:
        return True
    # Objects may be too fast to be tracked, but then some of many tracks start on them.
    has_tracks = len(evidence.score) >= LEAST_TRACKS
    moves = float((evidence.score > record.MOVES).mean()) > FALSE_SHARE
    return has_tracks and not moves and moving_share < MOST_MARKED


def known_paths(evidence: Evidence) -> KnownPaths:
    """Select the paths that are known in enough frames.

    Args:
      evidence: Preprocessing.

    Returns:
      The paths.
    """
    usable = _is_known(evidence)
    paths = [part[usable] for part in evidence.paths]
    position, is_known, _, deviation, is_rigid = paths
    tracks = evidence.path_tracks.take(usable)
    return KnownPaths(position, is_known, deviation, is_rigid, tracks)


def scene_unit(evidence: Evidence) -> float:
    """Return a typical distance, the median z-depth of static points.

    Args:
      evidence: Preprocessing.

    Returns:
      The distance in scene units, 1 if there are no points.
    """
    depth = evidence.static_fit.depth[evidence.tracks.visible]
    depth = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.median(depth)) if len(depth) else 1.0
