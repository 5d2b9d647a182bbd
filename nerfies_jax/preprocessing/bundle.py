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
# Penalty on second differences of the poses, in pixels over the distance: negligible,
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


def sight(views: Views, tracks: Tracks, known: np.ndarray) -> Sight:
    """Collect the observations of tracks.

    Args:
      views: The frames.
      tracks: The tracks.
      known: True for observations to use, [tracks, frames].

    Returns:
      The observations.
    """
    track, frame = np.nonzero(known)
    center = views.intrinsics[frame, :2, 2]
    to_px = views.intrinsics[frame, :2].copy()
    to_px[:, :, 2] = 0
    return Sight(track, frame, tracks.pixel[track, frame] - center, to_px)


def misses(views: Views, seen: Sight, body: Body) -> np.ndarray:
    """Compute reprojection errors.

    Args:
      views: The frames.
      seen: Observations.
      body: The object.

    Returns:
      Errors in pixels, [entries].
    """
    return np.linalg.norm(_projected(views, seen, body)[0], axis=-1)


def _projected(views, seen, body):
    """Errors [entries, 2] in px, and their gradients [entries, 2, 3] by the
    position.
    """
    turned = np.einsum("oij,oj->oi", body.rotation[seen.frame], body.point[seen.track])
    away = turned + (body.shift - views.position)[seen.frame]
    local = np.einsum("oij,oj->oi", views.rotation[seen.frame], away)
    depth = np.maximum(local[:, 2], NEAR * np.median(np.abs(local[:, 2])))
    pixel = np.einsum("oij,oj->oi", seen.to_px, local) / depth[:, None]
    slope = seen.to_px.copy()
    slope[:, :, 2] = -pixel
    slope = slope / depth[:, None, None] @ views.rotation[seen.frame]
    return pixel - seen.place, slope, turned


def adjusted(views: Views, seen: Sight, body: Body) -> Body:
    """Adjust points and poses to the observations.

    Args:
      views: The frames.
      seen: Observations.
      body: Initial object.

    Returns:
      The adjusted object.
    """
    return _descended(views, seen, body, _moved)


def posed(views: Views, seen: Sight, body: Body) -> Body:
    """Adjust the poses alone.

    Args:
      views: The frames.
      seen: Observations.
      body: Object whose points are correct.

    Returns:
      The object with adjusted poses.
    """
    return _descended(views, seen, body, _turned)


def _descended(views, seen, body, step):
    bend = _bend(views, body)
    cost, damping = _cost(views, seen, body, bend), DAMPING
    for _ in range(ROUNDS):
        system = _system(views, seen, body, bend)
        for _ in range(TRIES):
            candidate = step(body, system, damping)
            new = _cost(views, seen, candidate, bend)
            if new < cost:
                break
            damping *= 10
        else:
            break
        gained, cost, body = cost - new, new, candidate
        damping = max(damping / 10, LEAST_DAMPING)
        if gained < CONVERGED * cost:
            break
    return body


def _bend(views, body):
    """[frames, frames] weight of second differences of shifts and turns."""
    frames = len(body.shift)
    second = np.diff(np.eye(frames), 2, axis=0)
    distance = np.median(np.linalg.norm(body.shift - views.position, axis=-1))
    return (BEND_PX / max(distance, 1e-30)) ** 2 * second.T @ second


def _cost(views, seen, body, bend):
    miss_sq = (_projected(views, seen, body)[0] ** 2).sum(-1)
    robust = SOFT_PX**2 * np.log1p(miss_sq / SOFT_PX**2).sum()
    return robust + np.einsum("fi,fg,gi->", body.shift, bend, body.shift)


class _System(NamedTuple):
    poses: np.ndarray  # [6 frames, 6 frames]
    points: np.ndarray  # [points, 3, 3]
    both: np.ndarray  # [points, 6 frames, 3]
    pose_slope: np.ndarray  # [6 frames]
    point_slope: np.ndarray  # [points, 3]


def _system(views, seen, body, bend):
    """The normal equations of one round, weights as the misses are."""
    miss, slope, turned = _projected(views, seen, body)
    weight = _weights(miss)
    by_turn = np.cross(turned[:, None], slope)
    by_pose = np.concatenate([slope, by_turn], axis=-1)
    by_point = slope @ body.rotation[seen.frame]
    frames, points = len(body.shift), len(body.point)
    own = _summed(_products(weight, by_pose, by_pose), seen.frame, frames)
    poses = np.zeros((frames, 6, frames, 6))
    poses[np.arange(frames), :, np.arange(frames)] = own
    for part in range(6):
        poses[:, part, :, part] += bend
    both = np.zeros((points, frames, 6, 3))
    both[seen.track, seen.frame] = _products(weight, by_pose, by_point)
    off = miss[..., None]
    pose_slope = _summed(_products(weight, by_pose, off), seen.frame, frames)[..., 0]
    pose_slope[:, :3] += bend @ body.shift
    return _System(
        poses.reshape(6 * frames, 6 * frames),
        _summed(_products(weight, by_point, by_point), seen.track, points),
        both.reshape(points, 6 * frames, 3),
        pose_slope.ravel(),
        _summed(_products(weight, by_point, off), seen.track, points)[..., 0],
    )


def _weights(miss):
    """Weights of observations [entries], from errors [entries, 2] in px."""
    return 1 / (1 + (miss**2).sum(-1) / SOFT_PX**2)


def _products(weight, left, right):
    # The three in one einsum take two and a half times as long.
    return np.einsum("oki,okj->oij", weight[:, None, None] * left, right)


def _summed(product, where, rows):
    """[rows, ...] sums of the entries of each row."""
    entries = len(where)
    # Seven times as fast as numpy.add.at on 60,000 matrices of 6 by 6.
    which = scipy.sparse.csr_array(
        (np.ones(entries), where, np.arange(entries + 1)), shape=(entries, rows)
    )
    total = which.T @ product.reshape(entries, math.prod(product.shape[1:]))
    return total.reshape(rows, *product.shape[1:])


def _moved(body, system, damping):
    size = np.einsum("nii->n", system.points) / 3
    ridge = damping * size + POINT_PRIOR * max(np.median(size), 1e-30)
    inverse = np.linalg.inv(system.points + ridge[:, None, None] * np.eye(3))
    matrix = _damped(system.poses, damping)
    onto = system.both @ inverse
    flat = (len(matrix), -1)
    matrix -= onto.transpose(1, 0, 2).reshape(flat) @ (
        system.both.transpose(1, 0, 2).reshape(flat).T
    )
    right = np.einsum("nij,nj->i", onto, system.point_slope) - system.pose_slope
    pose = np.linalg.solve(matrix, right)
    back = system.point_slope + np.einsum("nij,i->nj", system.both, pose)
    point = body.point - np.einsum("nij,nj->ni", inverse, back)
    return _by(body._replace(point=point), pose)


def _turned(body, system, damping):
    return _by(
        body, np.linalg.solve(_damped(system.poses, damping), -system.pose_slope)
    )


def _damped(matrix, damping):
    diagonal = np.diagonal(matrix)
    ridge = damping * diagonal + 1e-6 * np.median(diagonal) + 1e-30
    return matrix + np.diag(ridge)


def _by(body, pose):
    """The body moved and turned by `pose` [6 frames]."""
    pose = pose.reshape(-1, 6)
    turn = Rotation.from_rotvec(pose[:, 3:]).as_matrix()
    return body._replace(rotation=turn @ body.rotation, shift=body.shift + pose[:, :3])


def placed(views: Views, seen: Sight, body: Body) -> Body:
    """Adjust the points alone.

    Args:
      views: The frames.
      seen: Observations.
      body: Object whose poses are correct.

    Returns:
      The object with adjusted points.
    """
    point = body.point.copy()
    for _ in range(ROUNDS // 4):
        miss, slope, _ = _projected(views, seen, body._replace(point=point))
        weight = _weights(miss)
        by_point = slope @ body.rotation[seen.frame]
        matrix, right = (
            _summed(_products(weight, by_point, other), seen.track, len(point))
            for other in (by_point, miss[..., None])
        )
        size = np.einsum("nii->n", matrix) / 3
        ridge = POINT_PRIOR * (size + max(np.median(size), 1e-30))
        matrix += ridge[:, None, None] * np.eye(3)
        point = point - np.linalg.solve(matrix, right)[..., 0]
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


def typical_misses(seen: Sight, miss: np.ndarray, tracks: int) -> np.ndarray:
    """Compute the median reprojection error of each track.

    Args:
      seen: Observations.
      miss: Their errors in pixels, [entries].
      tracks: Number of tracks.

    Returns:
      Medians in pixels [tracks], infinite for tracks without observations.
    """
    if not len(miss):
        return np.full(tracks, np.inf)
    ordered = np.lexsort((miss, seen.track))
    count = np.bincount(seen.track, minlength=tracks)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    at = np.minimum(first + count // 2, len(miss) - 1)
    return np.where(count > 0, miss[ordered][at], np.inf)
