"""Tracks of surface points, predicted by the motion of the Gaussians around them."""

import numpy as np
import scipy.spatial

from gaussians_jax.scene import scene
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.model_flow import Move, Moved
from nerfies_jax.evaluation.protocol import STATIC_POINTS, GroundTruth, PointTracks
from nerfies_jax.training import programs
from nerfies_jax.training.model import in_default_precision

NEIGHBORS = 8  # Gaussians that move a point
LEAST_OPACITY = 0.05  # Gaussians with a lower opacity do not move points


def follow(
    spec,
    metadata,
    state,
    capture: Capture,
    known: GroundTruth,
) -> PointTracks | None:
    """Predict ground-truth points at all other times from the Gaussians around them.

    A point moves like the average of the `NEIGHBORS` nearest visible Gaussians at the
    start time, with the weights of `neighbor_weights`. This predicts where the rendered
    surface at a point goes. It cannot tell if these Gaussians represent the point: next
    to a silhouette some belong to the surface behind it, and where Gaussians fade in
    and out instead of moving, a point stays. The average of a rotation is exact at the
    mean of the neighbors, and has an error that grows with the distance from it. All
    points are tracked, so none is lost. Gaussians define no Jacobian between them, so
    there is no strain.

    Args:
      spec: Settings of the scene.
      metadata: Metadata of the capture.
      state: State of the trained scene.
      capture: The capture.
      known: Ground truth, with `start_points` [tracks, 3] in scene units.

    Returns:
      Tracks in scene units. None without motion or without ground-truth points.
    """
    effects = scene.all_effects(spec, metadata)
    if all(effect.deform is None for effect in effects) or not len(known.path):
        return None
    deform = programs.deformer(scene.build(spec, metadata))(state.params)
    times = np.asarray(in_default_precision(capture.times[known.track_rows]))
    # [times, gaussians, 3]
    means = np.stack([np.asarray(deform(time).mean) for time in times])
    first = deform(times[known.start])
    opacity = np.asarray(first.opacity)
    path = _move_with_gaussians(known.start_points, means, opacity, known.start)
    drift = float("nan")
    if capture.points is not None:
        static = capture.points.position[:STATIC_POINTS]
        static = _move_with_gaussians(static, means, opacity, known.start)
        offset = static - static.mean(axis=1, keepdims=True)
        drift = float(np.linalg.norm(offset, axis=-1).mean())
    return PointTracks(
        path=path.astype(np.float32),
        converged=np.ones(path.shape[:2], bool),
        drift=drift,
        strain=float("nan"),
    )


def mover(spec, metadata) -> Move | None:
    """Return a function that moves points from the time of one view to another's.

    The function moves points as `follow` does. None if the scene has no motion.

    Args:
      spec: The scene.
      metadata: Scene metadata.

    Returns:
      The function, or None.
    """
    effects = scene.all_effects(spec, metadata)
    if all(effect.deform is None for effect in effects):
        return None
    deformer = programs.deformer(scene.build(spec, metadata))

    def move(state, points, source, target):
        deform = deformer(state.params)
        first, last = (deform(view.time) for view in (source, target))
        means = np.stack([np.asarray(first.mean), np.asarray(last.mean)])
        path = _move_with_gaussians(points, means, np.asarray(first.opacity), 0)
        return Moved(path[:, 1].astype(points.dtype), np.ones(len(points), bool))

    return move


def _move_with_gaussians(
    points: np.ndarray, means: np.ndarray, opacity: np.ndarray, start: int
) -> np.ndarray:
    """Move points with Gaussians. Without visible Gaussians, points stay."""
    rows = np.flatnonzero(opacity > LEAST_OPACITY)
    path = np.repeat(points[:, None].astype(float), len(means), axis=1)
    if not len(rows):
        return path
    tree = scipy.spatial.cKDTree(means[start, rows])
    count = min(NEIGHBORS, len(rows))
    distance, nearest = tree.query(points, np.arange(1, count + 1))
    nearest = rows[nearest]
    weight = neighbor_weights(distance, opacity[nearest])
    for index, mean in enumerate(means):
        shift = mean[nearest].astype(float) - means[start][nearest]
        path[:, index] += np.einsum("pk,pkd->pd", weight, shift)
    return path


def neighbor_weights(distance: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Compute the weights of the Gaussians that move a point.

    A weight is the opacity times a Gaussian of the distance, whose standard deviation
    is half the distance to the farthest neighbor. The extents of the Gaussians are not
    used, because they are thin across a surface and would leave a point next to it to a
    single Gaussian.

    Args:
      distance: [points, neighbors] distances, nearest first.
      opacity: [points, neighbors] opacities.

    Returns:
      [points, neighbors] weights that sum to one.
    """
    # If all neighbors coincide with the point, any width gives the same weights.
    width = np.where(distance[:, -1:] > 0, distance[:, -1:], 1.0) / 2
    weight = opacity * np.exp(-0.5 * (distance / width) ** 2)
    return weight / weight.sum(axis=1, keepdims=True)
