"""Rigid motion groups: tracks with constant distances, and the motion of each group.

No track needs to span the video. Tracks whose distance is constant while both are
visible belong together, and the motion of a group is propagated over time by points
that are also visible 8, 4 or 1 frames earlier.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.ndimage as nd
import scipy.sparse as sparse
from scipy.cluster.vq import kmeans2
from scipy.sparse.linalg import ArpackNoConvergence, eigsh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

# Pairs are spatial neighbors in at least one frame, and both visible in some frames.
NEIGHBORS, EVERY_FRAMES, SHARED_FRAMES = 12, 3, 5
HOPS = (8, 4)  # larger steps, if enough points are common, reduce drift
SHARED_POINTS, SHARED_SHARE = 10, 0.6
FEWEST = 6  # points that determine a rotation. With fewer only the shift is estimated.
SMOOTHED_FRAMES = 1.0  # standard deviation of the filter of poses over time
LANCZOS = 40  # vectors. With 20 it takes ten times as long.
ROUNDS = 3  # of robust Procrustes


class RigidMotion(NamedTuple):
    """Motion of groups from their positions in one frame: x(t) = rotation x + shift."""

    label: np.ndarray  # [paths] index of the group
    rotation: np.ndarray  # [groups, frames, 3, 3]
    shift: np.ndarray  # [groups, frames, 3] scene units


def labels(position: np.ndarray, known: np.ndarray, count: int) -> np.ndarray:
    """Group paths by spectral clustering on the constancy of their distances.

    Args:
      position: Positions, [paths, frames, 3].
      known: True for known positions, [paths, frames].
      count: Number of groups. At most half the number of paths is used.

    Returns:
      Group of each path in 0..count-1, [paths].
    """
    paths = len(position)
    count = min(count, max(1, paths // 2))
    if count == 1:
        return np.zeros(paths, int)
    first, second, is_common = _pairs(position, known)
    distance = np.linalg.norm(position[first] - position[second], axis=-1)
    distance = np.where(is_common, distance, np.nan)
    change, size = np.nanstd(distance, axis=1), np.nanmedian(distance, axis=1)
    typical = max(np.median(change), 1e-6 * np.median(size), 1e-30)
    near = np.exp(-size / max(2 * np.median(size), 1e-30))
    alike = np.exp(-0.5 * (change / typical) ** 2) * near + 1e-6
    entries = np.concatenate([alike, alike])
    where = np.concatenate([first, second]), np.concatenate([second, first])
    graph = sparse.coo_matrix((entries, where), shape=(paths, paths)).tocsr()
    scale = sparse.diags((np.asarray(graph.sum(1)).ravel() + 1e-9) ** -0.5)
    vectors = _leading(scale @ graph @ scale + 1e-9 * sparse.eye(paths), count)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    vectors = vectors / np.maximum(length, 1e-12)
    _, label = kmeans2(vectors, count, minit="++", seed=0, iter=50)
    return label


def _leading(matrix, count):
    """Return eigenvectors [rows, count] of the largest eigenvalues."""
    rows = matrix.shape[0]
    start, width = np.ones(rows), min(rows, max(2 * count + 1, LANCZOS))
    try:
        return eigsh(matrix, count, which="LA", v0=start, ncv=width, maxiter=100)[1]
    except ArpackNoConvergence:
        # For a single body the eigenvalues are nearly equal.
        last = rows - count, rows - 1
        return scipy.linalg.eigh(matrix.toarray(), subset_by_index=last)[1]


def _pairs(position, is_known):
    edges = set()
    for frame in range(0, is_known.shape[1], EVERY_FRAMES):
        here = np.flatnonzero(is_known[:, frame])
        if len(here) < 3:
            continue
        count = min(NEIGHBORS, len(here) - 1)
        _, near = cKDTree(position[here, frame]).query(position[here, frame], count + 1)
        mine = np.repeat(here, count)
        theirs = here[near[:, 1:]].ravel()
        low, high = np.minimum(mine, theirs), np.maximum(mine, theirs)
        edges.update(zip(low.tolist(), high.tolist(), strict=True))
    first, second = np.array(sorted(edges), int).reshape(-1, 2).T
    is_common = is_known[first] & is_known[second]
    overlaps = is_common.sum(1) >= min(SHARED_FRAMES, is_known.shape[1])
    return first[overlaps], second[overlaps], is_common[overlaps]


def motion(
    position: np.ndarray, known: np.ndarray, label: np.ndarray, canonical: int
) -> RigidMotion:
    """Estimate the motion of each group from a canonical frame.

    Args:
      position: Positions in scene units, [paths, frames, 3].
      known: True for known positions, [paths, frames].
      label: Group of each path, [paths].
      canonical: Index of the canonical frame.

    Returns:
      The motion.
    """
    frames = position.shape[1]
    groups = int(label.max()) + 1 if len(label) else 0
    rotation = np.tile(np.eye(3), (groups, frames, 1, 1))
    shift = np.zeros((groups, frames, 3))
    for group in range(groups):
        member = np.flatnonzero(label == group)
        if not len(member):
            continue
        # From the frame in which most of the group is visible.
        start = int(np.argmax(known[member].sum(0)))
        for sign in (1, -1):
            for frame in range(start + sign, frames if sign > 0 else -1, sign):
                source, (turn, move) = _estimate_step(
                    position, known, member, frame, sign, start
                )
                rotation[group, frame] = turn @ rotation[group, source]
                shift[group, frame] = turn @ shift[group, source] + move
        base, offset = rotation[group, canonical].copy(), shift[group, canonical].copy()
        rotation[group] = rotation[group] @ base.T
        shift[group] -= rotation[group] @ offset
    return RigidMotion(label, rotation, shift)


def _estimate_step(position, is_known, member, frame, sign, start):
    """Return the frame that the motion to `frame` is estimated from, and the motion."""
    before = frame - sign
    rows = member[is_known[member, before] & is_known[member, frame]]
    for hop in HOPS:
        source = frame - sign * hop
        if (source - start) * sign < 0:
            continue
        common = member[is_known[member, source] & is_known[member, frame]]
        if len(common) >= SHARED_POINTS and len(common) > SHARED_SHARE * len(rows):
            return source, procrustes(position[common, source], position[common, frame])
    if len(rows) >= FEWEST:
        return before, procrustes(position[rows, before], position[rows, frame])
    move = np.zeros(3)
    if len(rows):
        move = np.median(position[rows, frame] - position[rows, before], axis=0)
    return before, (np.eye(3), move)


def procrustes(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the rigid motion that aligns points with others by robust least squares.

    Args:
      source: Points, [points, 3].
      target: Corresponding points in the same unit, [points, 3].

    Returns:
      Rotation [3, 3] and translation [3], with `target` near rotation `source` +
      translation.

    References:
      Kabsch 1976.
    """
    weight = np.ones(len(source))
    for _ in range(ROUNDS):
        total = weight.sum()
        middle, other = weight @ source / total, weight @ target / total
        spread = ((source - middle) * weight[:, None]).T @ (target - other)
        left, _, right = np.linalg.svd(spread)
        mirror = np.diag([1, 1, np.sign(np.linalg.det(right.T @ left.T))])
        rotation = right.T @ mirror @ left.T
        shift = other - rotation @ middle
        miss = np.linalg.norm(source @ rotation.T + shift - target, axis=1)
        typical = np.median(miss) + 1e-12
        weight = 1 / (1 + (miss / typical) ** 2)
    return rotation, shift


def centers(
    position: np.ndarray, known: np.ndarray, bodies: RigidMotion
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the canonical position of each path, and the centers of groups.

    Args:
      position: Positions in scene units, [paths, frames, 3].
      known: True for known positions, [paths, frames].
      bodies: Motion of the groups.

    Returns:
      Median positions of paths [paths, 3] and of groups [groups, 3], in scene units.
    """
    canonical = np.zeros((len(position), 3))
    for row, group in enumerate(bodies.label):
        at = np.flatnonzero(known[row])
        back = position[row, at] - bodies.shift[group, at]
        local = np.einsum("tji,tj->ti", bodies.rotation[group, at], back)
        canonical[row] = np.median(local, axis=0)
    middle = np.zeros((len(bodies.rotation), 3))
    for group in np.unique(bodies.label):
        middle[group] = np.median(canonical[bodies.label == group], axis=0)
    return canonical, middle


def miss(position: np.ndarray, known: np.ndarray, count: int) -> float:
    """Compute the median error of the paths under the motion of a number of groups.

    Args:
      position: Positions in scene units, [paths, frames, 3].
      known: True for known positions, [paths, frames].
      count: Number of groups.

    Returns:
      The error in scene units.
    """
    label = labels(position, known, count)
    bodies = motion(position, known, label, position.shape[1] // 2)
    canonical, _ = centers(position, known, bodies)
    offset = np.einsum("ptij,pj->pti", bodies.rotation[label], canonical)
    away = np.linalg.norm(offset + bodies.shift[label] - position, axis=-1)
    return float(np.median(away[known]))


def fewest(
    position: np.ndarray, known: np.ndarray, within: float, most: int = 8
) -> tuple[int, float]:
    """Find the smallest number of groups that explains the paths.

    Args:
      position: Positions in scene units, [paths, frames, 3].
      known: True for known positions, [paths, frames].
      within: Median error in scene units that is small enough.
      most: Largest number of groups, returned if none is enough.

    Returns:
      The number of groups, and its median error in scene units.
    """
    for count in range(1, most + 1):
        typical = miss(position, known, count)
        if typical < within:
            break
    return count, typical


def enough(
    position: np.ndarray, known: np.ndarray, counts: Sequence[int], share: float
) -> int:
    """Find the number of groups beyond which more groups hardly reduce the error.

    The result reduces the median error by at least `share` of the difference between
    one group and the last of `counts`.

    Args:
      position: Positions in scene units, [paths, frames, 3].
      known: True for known positions, [paths, frames].
      counts: Numbers of groups in ascending order.
      share: Share of the reduction, in [0, 1].

    Returns:
      One of `counts`.
    """
    first, last = (miss(position, known, count) for count in (1, counts[-1]))
    limit = first - share * max(first - last, 0.0)
    return next(
        n for n in counts if n == counts[-1] or miss(position, known, n) <= limit
    )


def rotation_vectors(rotation: np.ndarray, canonical: int) -> np.ndarray:
    """Convert rotations to vectors that are continuous over time.

    Args:
      rotation: Rotations, [groups, frames, 3, 3].
      canonical: Index of the frame in which they are the identity.

    Returns:
      Rotation vectors in radians [groups, frames, 3], whose angles may exceed π.
    """
    groups, frames = rotation.shape[:2]
    vectors = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec()
    vectors = vectors.reshape(groups, frames, 3)
    onward = [(frame, frame - 1) for frame in range(canonical + 1, frames)]
    back = [(frame, frame + 1) for frame in range(canonical - 1, -1, -1)]
    for group in range(groups):
        for frame, before in onward + back:
            here = vectors[group, frame]
            angle = np.linalg.norm(here)
            if angle > 1e-6:
                turns = [here * (1 + 2 * np.pi * k / angle) for k in (-1, 0, 1)]
                last = vectors[group, before]
                near = [np.linalg.norm(turn - last) for turn in turns]
                vectors[group, frame] = turns[int(np.argmin(near))]
    return vectors


def smoothed(track: np.ndarray) -> np.ndarray:
    """Filter the jitter of single frames.

    Args:
      track: Values over time, [groups, frames, width].

    Returns:
      Filtered values of the same shape.
    """
    return nd.gaussian_filter1d(track, SMOOTHED_FRAMES, axis=1)
