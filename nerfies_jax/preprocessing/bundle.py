"""Bundle adjustment of one rigid object with known cameras.

It optimizes the points of the object and its pose in each frame (Triggs et al. 2000,
"Bundle adjustment - a modern synthesis") by Levenberg-Marquardt, with points eliminated
by the Schur complement. The result is determined up to one factor of all distances to
the cameras, which hardly changes from its initialization.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.sparse
from scipy.spatial.transform import Rotation

from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.view_set import Views

ROUNDS = 40
SOFT_PX = 0.5  # scale of the Cauchy loss
# The variance of the error of a position grows with the time to the start of its track,
# whose patch changes: the median error of a forearm is 0.06 px after 3 frames, 0.14
# after 10, and 0.3 after more than 20. With all tracks that begin on the mask and equal
# weights, the depths of two forearms oscillate by 1.8 and 2.3 % (standard deviation
# over time), and with these weights by 1.1 and 1.6 %.
TWICE_FRAMES = 1.5  # in which the variance doubles
# Weight of second differences of the shifts, in pixels over the distance: negligible,
# but sufficient in frames that do not show the object.
BEND_PX = 0.1
POINT_PRIOR = 1e-3  # relative to the information of a typical point
DAMPING, LEAST_DAMPING, TRIES = 1e-4, 1e-8, 8
CONVERGED = 1e-5  # relative reduction of the cost in a round
NEAR = 1e-6  # lower bound of the z-depth, relative to a typical one


class Body(NamedTuple):
    """Points of a rigid object, and its poses: world = rotation @ body + shift."""

    point: np.ndarray  # [points, 3] scene units, body axes
    rotation: np.ndarray  # [frames, 3, 3]
    shift: np.ndarray  # [frames, 3] scene units

    def world(self) -> np.ndarray:
        """Return the positions of the points in all frames.

        Returns:
          Positions in scene units, [points, frames, 3].
        """
        return np.einsum("fij,nj->nfi", self.rotation, self.point) + self.shift


class Sight(NamedTuple):
    """Observations of tracks, one entry for each track and frame."""

    track: np.ndarray  # [entries]
    frame: np.ndarray  # [entries]
    place: np.ndarray  # [entries, 2] px, from the principal point
    to_px: np.ndarray  # [entries, 2, 3] camera axes to pixels times depth
    weight: np.ndarray  # [entries] inverse variance, relative to the mean


def sight(views: Views, tracks: Tracks, valid: np.ndarray) -> Sight:
    """Collect the observations of tracks.

    Args:
      views: The frames.
      tracks: The tracks.
      valid: True for observations to use, [tracks, frames].

    Returns:
      The observations.
    """
    track, frame = np.nonzero(valid)
    center = views.intrinsics[frame, :2, 2]
    to_px = views.intrinsics[frame, :2].copy()
    to_px[:, :, 2] = 0
    weight = 1 / (1 + np.abs(frame - tracks.start[track]) / TWICE_FRAMES)
    weight /= weight.mean() if len(weight) else 1.0
    return Sight(track, frame, tracks.pixel[track, frame] - center, to_px, weight)


def misses(views: Views, sight: Sight, body: Body) -> np.ndarray:
    """Compute reprojection errors.

    Args:
      views: The frames.
      sight: Observations.
      body: The object.

    Returns:
      Errors in pixels, [entries].
    """
    return np.linalg.norm(_reproject(views, sight, body)[0], axis=-1)


def _reproject(views, sight, body):
    """Compute errors [entries, 2] in px, and their gradients [entries, 2, 3].

    The gradients are by the position of the point. The third value is the position
    relative to the center of the body, in world axes.
    """
    arm = np.einsum("oij,oj->oi", body.rotation[sight.frame], body.point[sight.track])
    offset = arm + (body.shift - views.position)[sight.frame]
    local = np.einsum("oij,oj->oi", views.rotation[sight.frame], offset)
    depth = np.maximum(local[:, 2], NEAR * np.median(np.abs(local[:, 2])))
    pixel = np.einsum("oij,oj->oi", sight.to_px, local) / depth[:, None]
    gradient = sight.to_px.copy()
    gradient[:, :, 2] = -pixel
    gradient = gradient / depth[:, None, None] @ views.rotation[sight.frame]
    return pixel - sight.place, gradient, arm


def adjusted(views: Views, sight: Sight, body: Body, bend_px: float = BEND_PX) -> Body:
    """Adjust points and poses to the observations.

    Args:
      views: The frames.
      sight: Observations.
      body: Initial object.
      bend_px: Weight of second differences of the shifts, in pixels over the distance.

    Returns:
      The adjusted object.
    """
    return _minimize(views, sight, body, _step_of_all, bend_px)


def posed(views: Views, sight: Sight, body: Body) -> Body:
    """Adjust the poses alone.

    Args:
      views: The frames.
      sight: Observations.
      body: Object whose points are correct.

    Returns:
      The object with adjusted poses.
    """
    return _minimize(views, sight, body, _step_of_poses)


def _minimize(views, sight, body, step, bend_px=BEND_PX):
    smoothness = _smoothness(views, body, bend_px)
    cost, damping = _cost(views, sight, body, smoothness), DAMPING
    for _ in range(ROUNDS):
        system = _system(views, sight, body, smoothness)
        for _ in range(TRIES):
            candidate = step(body, system, damping)
            new = _cost(views, sight, candidate, smoothness)
            if new < cost:
                break
            damping *= 10
        else:
            break
        decrease, cost, body = cost - new, new, candidate
        damping = max(damping / 10, LEAST_DAMPING)
        if decrease < CONVERGED * cost:
            break
    return body


def _smoothness(views, body, bend_px):
    """Return the penalty [frames, frames] on second differences of shifts."""
    frames = len(body.shift)
    second = np.diff(np.eye(frames), 2, axis=0)
    distance = np.median(np.linalg.norm(body.shift - views.position, axis=-1))
    return (bend_px / max(distance, 1e-30)) ** 2 * second.T @ second


def _cost(views, sight, body, smoothness):
    miss_sq = (_reproject(views, sight, body)[0] ** 2).sum(-1)
    robust = SOFT_PX**2 * (sight.weight * np.log1p(miss_sq / SOFT_PX**2)).sum()
    return robust + np.einsum("fi,fg,gi->", body.shift, smoothness, body.shift)


class _System(NamedTuple):
    """Normal equations of a round, by blocks of poses and points."""

    poses: np.ndarray  # [6 frames, 6 frames]
    points: np.ndarray  # [points, 3, 3]
    mixed: np.ndarray  # [points, 6 frames, 3]
    pose_gradient: np.ndarray  # [6 frames]
    point_gradient: np.ndarray  # [points, 3]


def _system(views, sight, body, smoothness):
    """Build the normal equations of one round, weighted by the Cauchy loss."""
    miss, gradient, arm = _reproject(views, sight, body)
    weight = _weights(sight, miss)
    by_turn = np.cross(arm[:, None], gradient)
    by_pose = np.concatenate([gradient, by_turn], axis=-1)
    by_point = gradient @ body.rotation[sight.frame]
    frames, points = len(body.shift), len(body.point)
    pose_blocks = _sum_by_row(_products(weight, by_pose, by_pose), sight.frame, frames)
    poses = np.zeros((frames, 6, frames, 6))
    poses[np.arange(frames), :, np.arange(frames)] = pose_blocks
    for part in range(6):
        poses[:, part, :, part] += smoothness
    cross_blocks = np.zeros((points, frames, 6, 3))
    cross_blocks[sight.track, sight.frame] = _products(weight, by_pose, by_point)
    error = miss[..., None]
    pose_gradient = _sum_by_row(_products(weight, by_pose, error), sight.frame, frames)
    pose_gradient = pose_gradient[..., 0]
    pose_gradient[:, :3] += smoothness @ body.shift
    return _System(
        poses.reshape(6 * frames, 6 * frames),
        _sum_by_row(_products(weight, by_point, by_point), sight.track, points),
        cross_blocks.reshape(points, 6 * frames, 3),
        pose_gradient.ravel(),
        _sum_by_row(_products(weight, by_point, error), sight.track, points)[..., 0],
    )


def _weights(sight, miss):
    """Return weights of observations [entries] from errors [entries, 2] in px."""
    return sight.weight / (1 + (miss**2).sum(-1) / SOFT_PX**2)


def _products(weight, first, second):
    # The three in one einsum take two and a half times as long.
    return np.einsum("oki,okj->oij", weight[:, None, None] * first, second)


def _sum_by_row(blocks, row, rows):
    """Sum the blocks of each row, [rows, ...]."""
    entries = len(row)
    # Seven times as fast as numpy.add.at on 60,000 matrices of 6 by 6.
    selection = scipy.sparse.csr_array(
        (np.ones(entries), row, np.arange(entries + 1)), shape=(entries, rows)
    )
    total = selection.T @ blocks.reshape(entries, math.prod(blocks.shape[1:]))
    return total.reshape(rows, *blocks.shape[1:])


def _step_of_all(body, system, damping):
    size = np.einsum("nii->n", system.points) / 3
    ridge = damping * size + POINT_PRIOR * max(np.median(size), 1e-30)
    inverse = np.linalg.inv(system.points + ridge[:, None, None] * np.eye(3))
    matrix = _damp(system.poses, damping)
    projection = system.mixed @ inverse
    flat = (len(matrix), -1)
    matrix -= projection.transpose(1, 0, 2).reshape(flat) @ (
        system.mixed.transpose(1, 0, 2).reshape(flat).T
    )
    target = (
        np.einsum("nij,nj->i", projection, system.point_gradient) - system.pose_gradient
    )
    pose = np.linalg.solve(matrix, target)
    residual = system.point_gradient + np.einsum("nij,i->nj", system.mixed, pose)
    point = body.point - np.einsum("nij,nj->ni", inverse, residual)
    return _posed_by(body._replace(point=point), pose)


def _step_of_poses(body, system, damping):
    return _posed_by(
        body, np.linalg.solve(_damp(system.poses, damping), -system.pose_gradient)
    )


def _damp(matrix, damping):
    diagonal = np.diagonal(matrix)
    ridge = damping * diagonal + 1e-6 * np.median(diagonal) + 1e-30
    return matrix + np.diag(ridge)


def _posed_by(body, pose):
    """Add `pose` [6 frames], shifts and turns of each frame, to a body."""
    pose = pose.reshape(-1, 6)
    turn = Rotation.from_rotvec(pose[:, 3:]).as_matrix()
    return body._replace(rotation=turn @ body.rotation, shift=body.shift + pose[:, :3])


def placed(views: Views, sight: Sight, body: Body) -> Body:
    """Adjust the points alone.

    Args:
      views: The frames.
      sight: Observations.
      body: Object whose poses are correct.

    Returns:
      The object with adjusted points.
    """
    point = body.point.copy()
    for _ in range(ROUNDS // 4):
        miss, gradient, _ = _reproject(views, sight, body._replace(point=point))
        weight = _weights(sight, miss)
        by_point = gradient @ body.rotation[sight.frame]
        matrix, target = (
            _sum_by_row(_products(weight, by_point, factor), sight.track, len(point))
            for factor in (by_point, miss[..., None])
        )
        size = np.einsum("nii->n", matrix) / 3
        ridge = POINT_PRIOR * (size + max(np.median(size), 1e-30))
        matrix += ridge[:, None, None] * np.eye(3)
        point = point - np.linalg.solve(matrix, target)[..., 0]
    return body._replace(point=point)


def scaled(views: Views, body: Body, factor: float) -> Body:
    """Scale size and distance of an object, which leaves its projections unchanged.

    Args:
      views: The frames.
      body: The object.
      factor: The factor.

    Returns:
      The scaled object.
    """
    shift = views.position + factor * (body.shift - views.position)
    return Body(factor * body.point, body.rotation, shift)


def typical_misses(sight: Sight, miss: np.ndarray, tracks: int) -> np.ndarray:
    """Compute the median reprojection error of each track.

    Args:
      sight: Observations.
      miss: Their errors in pixels, [entries].
      tracks: Number of tracks.

    Returns:
      Medians in pixels [tracks], infinite for tracks without observations.
    """
    if not len(miss):
        return np.full(tracks, np.inf)
    order = np.lexsort((miss, sight.track))
    count = np.bincount(sight.track, minlength=tracks)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    at = np.minimum(first + count // 2, len(miss) - 1)
    return np.where(count > 0, miss[order][at], np.inf)
