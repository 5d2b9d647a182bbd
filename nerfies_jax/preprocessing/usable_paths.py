"""Paths for the initialization of motion: those that are known long enough."""

import warnings
from typing import NamedTuple

import numpy as np

from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
from nerfies_jax.preprocessing import record
from nerfies_jax.preprocessing.record import Evidence
from nerfies_jax.training.track_start import TrackStartSpec

LEAST_SEEN = 6  # frames in which a path is known
LEAST_PATHS = 12
LEAST_MOVING = 0.005  # of the pixels: videos of still scenes have up to 0.4 % marked
MARKED = 0.01  # of the pixels: from here on something moves, followed or not


class KnownPaths(NamedTuple):
    """Positions of moving points over the frames of preprocessing."""

    position: np.ndarray  # [paths, frames, 3] scene units; any value where not known
    known: np.ndarray  # [paths, frames] bool
    depth_deviation: np.ndarray  # [paths] as a share of the depth


def evidence_to_start_from(capture: Capture, start: TrackStartSpec) -> Evidence | None:
    """Preprocess a capture for the initialization of motion, or read it from the cache.

    Args:
      capture: The capture.
      start: Settings of the initialization.

    Returns:
      The results. None if `start` does not ask for tracks, or if they are unusable,
      which a warning reports.
    """
    if start.motion != "tracks":
        return None
    evidence = record.cached(capture, CACHE / "evidence", start.use_depths)
    reason = unusable(evidence)
    if not reason:
        return evidence
    warnings.warn(
        f"{capture.path or capture.name}: the motion starts from rest, for tracks are "
        f"of no use here: {reason}; what moves by more than a few pixels will not be "
        "found. It moves from the first step on, with all bands open, and a field's "
        "warp learns slowly: start.motion=none gives the preset's own schedule back",
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
    if not evidence.told and evidence.moving.mean() < LEAST_MOVING:
        return f"only {evidence.moving.mean():.1%} of the pixels move by themselves"
    count = len(known_paths(evidence).known)
    if count < LEAST_PATHS:
        return f"only {count} tracks of what moves are long enough to fit a motion to"
    return ""


def stands_still(evidence: Evidence, times: np.ndarray) -> bool:
    """Return whether nothing moves: a single time, or only static tracks.

    Args:
      evidence: Preprocessing.
      times: Times of all frames of the capture, [frames].

    Returns:
      True for a static scene.
    """
    if np.ptp(times[evidence.row]) == 0:
        return True
    # More that is marked and cannot be followed may be too fast for that.
    unmarked = not evidence.told and float(evidence.moving.mean()) < MARKED
    return bool(unmarked and not evidence.unusable and unusable(evidence))


def known_paths(evidence: Evidence) -> KnownPaths:
    """Select the paths that are known in at least `LEAST_SEEN` frames.

    Args:
      evidence: Preprocessing.

    Returns:
      The paths.
    """
    kept = evidence.paths.known.sum(1) >= LEAST_SEEN
    paths = evidence.paths
    return KnownPaths(
        paths.position[kept], paths.known[kept], paths.depth_deviation[kept]
    )


def scene_unit(evidence: Evidence) -> float:
    """Return a typical distance, the median z-depth of static points.

    Args:
      evidence: Preprocessing.

    Returns:
      The distance in scene units, 1 if there are no points.
    """
    depth = evidence.rest.depth[evidence.tracks.seen]
    depth = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.median(depth)) if len(depth) else 1.0
