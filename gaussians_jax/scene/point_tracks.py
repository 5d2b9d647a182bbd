"""Points followed through time by the Gaussians around them."""

import jax
import numpy as np
import scipy.spatial

from gaussians_jax.scene import scene
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.model_flow import Move, Moved
from nerfies_jax.evaluation.protocol import STATIC_POINTS, GroundTruth, PointTracks
from nerfies_jax.training.model import in_default_precision

NEIGHBORS = 8  # Gaussians that carry a point
LEAST_OPACITY = 0.05  # of a Gaussian that can carry one; fainter ones are not seen


def follow(
    spec,
    metadata,
    state,
    capture: Capture,
    known: GroundTruth,
) -> PointTracks | None:
    """Predict ground-truth points at all other times, moved by the Gaussians around
    them.

    A point moves as the `NEIGHBORS` nearest Gaussians that can be seen do on average,
    where they are at the start; `neighbor_weights` says how much each counts. This
    tells where what is drawn at a point goes. It cannot tell whether these Gaussians
    stand for the point: beside a silhouette some belong to what is behind it, and where
    Gaussians fade in and out instead of moving, a point stays. The average of a turn is
    exact at the mean of the neighbors, and off by the turn of the way from there.
    Every point is carried by something, so none is lost; between Gaussians there is no
    Jacobian, so no strain. `known.start_points` [tracks, 3] and the result are in scene
    units, `state` is that of `scene.build`. None without motion or without points.
    """
    every = scene.all_effects(spec, metadata)
    if all(effect.deform is None for effect in every) or not len(known.path):
        return None
    stages = scene.build(spec, metadata).stages
    assert stages is not None
    prepared = jax.jit(stages.prepare)(state.params)
    deform = jax.jit(lambda params, ready, time: stages.deform(params, ready, time))
    times = in_default_precision(capture.times[known.moments])
    # [moments, gaussians, 3]
    means = np.stack(
        [np.asarray(deform(state.params, prepared, time).mean) for time in times]
    )
    first = deform(state.params, prepared, times[known.start])
    opacity = np.asarray(first.opacity)
    path = carried(known.start_points, means, opacity, known.start)
    drift = float("nan")
    if capture.points is not None:
        static = capture.points.position[:STATIC_POINTS]
        static = carried(static, means, opacity, known.start)
        apart = static - static.mean(axis=1, keepdims=True)
        drift = float(np.linalg.norm(apart, axis=-1).mean())
    return PointTracks(
        path=path.astype(np.float32),
        found=np.ones(path.shape[:2], bool),
        drift=drift,
        strain=float("nan"),
    )


def mover(spec, metadata) -> Move | None:
    """Return a function that moves points from one view's time to another's (`follow`).

    None where nothing moves the Gaussians.
    """
    every = scene.all_effects(spec, metadata)
    if all(effect.deform is None for effect in every):
        return None
    stages = scene.build(spec, metadata).stages
    assert stages is not None

    @jax.jit
    def deform(params, time):
        return stages.deform(params, stages.prepare(params), time)

    def move(state, points, here, there):
        first, last = (deform(state.params, view.time) for view in (here, there))
        means = np.stack([np.asarray(first.mean), np.asarray(last.mean)])
        path = carried(points, means, np.asarray(first.opacity), 0)
        return Moved(path[:, 1].astype(points.dtype), np.ones(len(points), bool))

    return move


def carried(
    points: np.ndarray, means: np.ndarray, opacity: np.ndarray, start: int
) -> np.ndarray:
    """Move points [points, 3] with Gaussians: [points, times, 3].

    `means` [moments, gaussians, 3] are theirs; the points are given at moment `start`.
    Rows that are not active have no opacity, and so carry nothing.
    Where no Gaussian can be seen, points stay.
    """
    rows = np.flatnonzero(opacity > LEAST_OPACITY)
    path = np.repeat(points[:, None].astype(float), len(means), axis=1)
    if not len(rows):
        return path
    tree = scipy.spatial.cKDTree(means[start, rows])
    count = min(NEIGHBORS, len(rows))
    distance, nearest = tree.query(points, np.arange(1, count + 1))
    nearest = rows[nearest]
    weight = neighbor_weights(distance, opacity[nearest])
    for moment, mean in enumerate(means):
        moved = mean[nearest].astype(float) - means[start][nearest]
        path[:, moment] += np.einsum("pk,pkd->pd", weight, moved)
    return path


def neighbor_weights(distance: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Weights [points, neighbors] that sum to one, nearest neighbor first.

    Opacity times a Gaussian of the distance, as wide as half the way to the farthest
    of the neighbors: not their own extents, which are thin across a surface and would
    leave a point beside it to a single one.
    """
    # Where all lie at the point itself, no distance differs, whatever the width.
    width = np.where(distance[:, -1:] > 0, distance[:, -1:], 1.0) / 2
    weight = opacity * np.exp(-0.5 * (distance / width) ** 2)
    return weight / weight.sum(axis=1, keepdims=True)
