"""Ground truth of a scene, and evaluation of point tracks by its learned motion.

Lengths are in scene units. `heldout.heldout_metrics` computes all metrics.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.synthetic import TRUTH_FILE, SceneTruth
from nerfies_jax.capture.synthetic import truth as truths
from nerfies_jax.metrics import geometry_quality

CORRECT_WITHIN = 0.01  # scene units, a quarter of the half-side of the default cube
STATIC_POINTS = 500  # of the capture, for measuring the drift of static points


class GroundTruth(NamedTuple):
    """Ground truth of a built-in scene, in NumPy."""

    rows: np.ndarray  # held-out frames to render
    track_rows: np.ndarray  # training frames, by time, at which tracks are known
    path: np.ndarray  # [tracks, times, 3] positions in scene units
    visible: np.ndarray  # [tracks, times] True if visible to the training camera
    # Index into `track_rows` from which points are tracked, the middle one. It is not
    # the first, because the template of D-NeRF is the scene at time 0, where its warp
    # is discontinuous.
    start: int

    @property
    def start_points(self) -> np.ndarray:
        """True positions of the points at the start, [tracks, 3], in scene units."""
        return self.path[:, self.start]


class PointTracks(NamedTuple):
    """Points moved by a learned deformation."""

    path: np.ndarray  # [tracks, times, 3] scene units, the start if not found
    converged: np.ndarray  # [tracks, times] bool
    # Mean distance, in scene units, of static points from their mean over time. Points
    # are mapped to the template, whose own position is arbitrary. Gaussians have no
    # template, so the distance is that of the points themselves.
    drift: float
    # Root mean square of ||log Σ||, where Σ are the singular values of the Jacobian of
    # the deformation at the true points. NaN if there is no Jacobian.
    strain: float


def stored_truth(capture: Capture) -> SceneTruth | None:
    """Read the ground truth stored with a built-in scene.

    Args:
      capture: The capture.

    Returns:
      The ground truth, None for a real capture.

    Raises:
      ValueError: If it cannot be read.
    """
    path = None if capture.path is None else capture.path / TRUTH_FILE
    return None if path is None or not path.is_file() else truths.load(path)


def ground_truth(
    capture: Capture, truth: SceneTruth, frames: int, tracks: int
) -> GroundTruth:
    """Select held-out frames, and points visible at the start.

    Args:
      capture: The capture.
      truth: Its ground truth.
      frames: Largest number of frames.
      tracks: Largest number of points.

    Returns:
      The selected ground truth.

    Raises:
      ValueError: If the ground truth belongs to another capture.
    """
    track_rows = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    path = truths.track_places(capture, truth, track_rows)
    start = len(track_rows) // 2
    visible = np.flatnonzero(truth.track_seen[:, track_rows[start]])
    points = evaluation.spread(visible, tracks) if len(visible) else visible
    return GroundTruth(
        rows=evaluation.spread(capture.heldout, frames),
        track_rows=track_rows,
        path=path[points],
        visible=truth.track_seen[points][:, track_rows],
        start=start,
    )


def score_tracks(known: GroundTruth, followed: PointTracks | None) -> dict[str, float]:
    """Evaluate point tracks at the visible points of all times except the start.

    Args:
      known: Ground truth.
      followed: Predicted tracks, or None.

    Returns:
      Metrics by the keys of `heldout.TOLERANCES`, NaN without tracks.
    """
    parts = ("epe", "correct", "lost", "drift", "strain")
    names = [f"tracks.{part}" for part in parts]
    if followed is None or not len(known.path):
        return dict.fromkeys(names, float("nan"))
    errors = _endpoints(followed.path, known)
    lost_share = 1 - followed.converged[_scored_mask(known)].mean()
    values = (
        errors.endpoint,
        errors.correct,
        lost_share,
        followed.drift,
        followed.strain,
    )
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def static_error(known: GroundTruth) -> float:
    """Compute the end-point error of static tracks, the baseline of point tracks.

    Args:
      known: Ground truth.

    Returns:
      The error in scene units, NaN without tracks.
    """
    if not len(known.path):
        return float("nan")
    static = np.broadcast_to(known.start_points[:, None], known.path.shape)
    return float(_endpoints(static, known)[0])


def _scored_mask(truth):
    """Return a mask of the visible points, except at the start."""
    mask = truth.visible.copy()
    mask[:, truth.start] = False
    return mask


def _endpoints(path, truth):
    return _track_errors(path, truth.path, _scored_mask(truth))


@jax.jit  # because its operations take longer to compile separately
def _track_errors(path, truth, visible):
    return geometry_quality.track_errors(path, truth, visible, CORRECT_WITHIN)


# (spec, metadata, state, capture, known, effects=()) -> None without a deformation
Follow = Callable[..., PointTracks | None]
