"""Ground truth of a trained scene, and point tracks by its learned motion.

Everything is in scene units. `heldout.heldout_metrics` computes the metrics.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.synthetic import TRUTH_FILE, SceneTruth
from nerfies_jax.capture.synthetic import truth as truths
from nerfies_jax.metrics import geometry_quality

CORRECT_WITHIN = 0.01  # scene units: a quarter of the default cube's half-side
STATIC_POINTS = 500  # of the capture's static points, to see whether they drift


class GroundTruth(NamedTuple):
    """Ground truth of a built-in scene, in NumPy."""

    rows: np.ndarray  # held-out frames of the capture that are rendered
    moments: np.ndarray  # frames learned from, in time: when points are looked for
    path: np.ndarray  # [tracks, moments, 3] where they are, scene units
    seen: (
        np.ndarray
    )  # [tracks, moments] whether the camera that is learned from sees it
    # The moment from which points are followed: the middle one. D-NeRF's template is
    # what it sees at time 0, and its warp jumps there.
    start: int

    @property
    def start_points(self) -> np.ndarray:
        """Known positions of the points at the start, [tracks, 3], in scene units."""
        return self.path[:, self.start]


class PointTracks(NamedTuple):
    """Points as moved by a learned warp."""

    path: np.ndarray  # [tracks, moments, 3] scene units; the start where not found
    found: np.ndarray  # [tracks, moments] bool
    # Mean distance of static points in the template from where they are on average;
    # where that is does not matter: a template may lie anywhere. Gaussians have no
    # template: the distance is that of the points themselves. Scene units.
    drift: float
    # Root mean square of ||log Σ|| of the Jacobian at the true points; NaN where there
    # is no Jacobian.
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
      ValueError: If the truth is not that of the capture.
    """
    moments = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    path = truths.track_places(capture, truth, moments)
    start = len(moments) // 2
    chosen = np.flatnonzero(truth.track_seen[:, moments[start]])
    if len(chosen):
        chosen = evaluation.spread(chosen, tracks)
    return GroundTruth(
        rows=evaluation.spread(capture.heldout, frames),
        moments=moments,
        path=path[chosen],
        seen=truth.track_seen[chosen][:, moments],
        start=start,
    )


def score_tracks(known: GroundTruth, followed: PointTracks | None) -> dict[str, float]:
    """Evaluate point tracks over the visible points of all times but the start.

    Args:
      known: Ground truth.
      followed: Predicted tracks, or None.

    Returns:
      Metrics by name, NaN without tracks.
    """
    names = ("track_error", "track_correct", "track_lost", "drift", "strain")
    if followed is None or not len(known.path):
        return dict.fromkeys(names, float("nan"))
    errors = _endpoints(followed.path, known)
    lost = 1 - followed.found[_scored(known)].mean()
    values = (errors.endpoint, errors.correct, lost, followed.drift, followed.strain)
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def static_error(known: GroundTruth) -> float:
    """Compute the end-point error of the prediction that nothing moves.

    Args:
      known: Ground truth.

    Returns:
      The error in scene units, NaN without tracks.
    """
    if not len(known.path):
        return float("nan")
    return float(
        _endpoints(
            np.broadcast_to(known.start_points[:, None], known.path.shape),
            known,
        )[0]
    )


def _scored(known):
    """Seen, and not given."""
    scored = known.seen.copy()
    scored[:, known.start] = False
    return scored


def _endpoints(path, known):
    return _track_errors(
        jnp.asarray(path), jnp.asarray(known.path), jnp.asarray(_scored(known))
    )


@jax.jit  # by themselves its operations take longer to compile
def _track_errors(path, truth, seen):
    return geometry_quality.track_errors(path, truth, seen, CORRECT_WITHIN)


# (spec, metadata, state, capture, known, effects=()) -> None where nothing is warped
Follow = Callable[..., PointTracks | None]
