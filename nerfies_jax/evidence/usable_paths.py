"""What a motion can start from: the paths that are known long enough."""

import warnings
from typing import NamedTuple

import numpy as np

from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evidence import record
from nerfies_jax.evidence.record import Evidence
from nerfies_jax.training.track_start import TrackStartSpec

LEAST_SEEN = 6  # frames in which a path is known
LEAST_PATHS = 12
LEAST_MOVING = 0.005  # of the pixels: films of still scenes have up to 0.4 % marked
MARKED = 0.01  # of the pixels: from here on something moves, followed or not


class KnownPaths(NamedTuple):
    """Where points that move were seen to be, over the frames of the evidence."""

    position: np.ndarray  # [paths, frames, 3] scene units; any value where not known
    known: np.ndarray  # [paths, frames] bool
    depth_deviation: np.ndarray  # [paths] as a share of the depth


def evidence_to_start_from(capture: Capture, start: TrackStartSpec) -> Evidence | None:
    """What the pictures say of the motion, gathered or read from the cache.

    None where `start` asks for none, or the film allows none, which a warning says.
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
    """Why a motion cannot start from these tracks; empty where it can."""
    if evidence.unusable:
        return evidence.unusable
    if not evidence.told and evidence.moving.mean() < LEAST_MOVING:
        return f"only {evidence.moving.mean():.1%} of the pixels move by themselves"
    count = len(known_paths(evidence).known)
    if count < LEAST_PATHS:
        return f"only {count} tracks of what moves are long enough to fit a motion to"
    return ""


def stands_still(evidence: Evidence, times: np.ndarray) -> bool:
    """Whether there is nothing to move: one moment, or tracks that all stand still.

    `times` are the capture's, of all its frames.
    """
    if np.ptp(times[evidence.row]) == 0:
        return True
    # More that is marked and cannot be followed may be too fast for that.
    unmarked = not evidence.told and float(evidence.moving.mean()) < MARKED
    return bool(unmarked and not evidence.unusable and unusable(evidence))


def known_paths(evidence: Evidence) -> KnownPaths:
    """The paths known in `LEAST_SEEN` frames and more."""
    kept = evidence.paths.known.sum(1) >= LEAST_SEEN
    paths = evidence.paths
    return KnownPaths(
        paths.position[kept], paths.known[kept], paths.depth_deviation[kept]
    )


def scene_unit(evidence: Evidence) -> float:
    """A typical distance: the median z-depth of points at rest, scene units."""
    depth = evidence.rest.depth[evidence.tracks.seen]
    depth = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.median(depth)) if len(depth) else 1.0
