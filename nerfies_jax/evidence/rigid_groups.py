"""Tracks that keep their distances move as one rigid thing; how each such thing moves.

No track need live through the film: whose distance stays constant while both are seen
belongs together, and a group is carried over time by the points that it shares with a
frame 8, 4 or 1 before.
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

# Pairs are neighbors in space in some frame, and seen together in some.
NEIGHBORS, EVERY_FRAMES, SHARED_FRAMES = 12, 3, 5
HOPS = (8, 4)  # frames at once where enough points are shared, against drift
SHARED_POINTS, SHARED_SHARE = 10, 0.6
FEWEST = 6  # points that tell a turn; fewer tell a shift
SMOOTHED_FRAMES = 1.0  # deviation, of poses over time
LANCZOS = 40  # vectors; with 20 it takes ten times as long
ROUNDS = 3  # of robust Procrustes


class RigidMotion(NamedTuple):
    """How groups move, from where they are in one frame: x(t) = rotation x + shift."""

    label: np.ndarray  # [paths] which group
    rotation: np.ndarray  # [groups, frames, 3, 3]
    shift: np.ndarray  # [groups, frames, 3] scene units


def labels(position: np.ndarray, known: np.ndarray, count: int) -> np.ndarray:
    """[paths] in 0..count-1: spectral clustering by how constant distances stay.

    `position` [paths, frames, 3], `known` [paths, frames]. Fewer groups where there are
    fewer paths than twice the count.
    """
    paths = len(position)
    count = min(count, max(1, paths // 2))
    if count == 1:
        return np.zeros(paths, int)
    first, second, both = _pairs(position, known)
    distance = np.linalg.norm(position[first] - position[second], axis=-1)
    distance = np.where(both, distance, np.nan)
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
    """[rows, count] eigenvectors of the largest eigenvalues of a sparse matrix."""
    rows = matrix.shape[0]
    start, width = np.ones(rows), min(rows, max(2 * count + 1, LANCZOS))
    try:
        return eigsh(matrix, count, which="LA", v0=start, ncv=width, maxiter=100)[1]
    except ArpackNoConvergence:
        # Where one body is all there is, eigenvalues lie too close together.
        last = rows - count, rows - 1
        return scipy.linalg.eigh(matrix.toarray(), subset_by_index=last)[1]


def _pairs(position, known):
    edges = set()
    for frame in range(0, known.shape[1], EVERY_FRAMES):
        here = np.flatnonzero(known[:, frame])
        if len(here) < 3:
            continue
        wanted = min(NEIGHBORS, len(here) - 1)
        _, near = cKDTree(position[here, frame]).query(
            position[here, frame], wanted + 1
        )
        mine = np.repeat(here, wanted)
        theirs = here[near[:, 1:]].ravel()
        low, high = np.minimum(mine, theirs), np.maximum(mine, theirs)
        edges.update(zip(low.tolist(), high.tolist(), strict=True))
    first, second = np.array(sorted(edges), int).reshape(-1, 2).T
    both = known[first] & known[second]
    kept = both.sum(1) >= min(SHARED_FRAMES, known.shape[1])
    return first[kept], second[kept], both[kept]


def motion(
    position: np.ndarray, known: np.ndarray, label: np.ndarray, canonical: int
) -> RigidMotion:
    """How each group moves, as seen from the frame `canonical`.

    `position` [paths, frames, 3] scene units, `known` [paths, frames], `label` [paths].
    """
    frames = position.shape[1]
    groups = int(label.max()) + 1 if len(label) else 0
    rotation = np.tile(np.eye(3), (groups, frames, 1, 1))
    shift = np.zeros((groups, frames, 3))
    for group in range(groups):
        member = np.flatnonzero(label == group)
        if not len(member):
            continue
        # From where most of it is seen.
        start = int(np.argmax(known[member].sum(0)))
        for sign in (1, -1):
            for frame in range(start + sign, frames if sign > 0 else -1, sign):
                source, (turn, move) = _carried(
                    position, known, member, frame, sign, start
                )
                rotation[group, frame] = turn @ rotation[group, source]
                shift[group, frame] = turn @ shift[group, source] + move
        base, offset = rotation[group, canonical].copy(), shift[group, canonical].copy()
        rotation[group] = rotation[group] @ base.T
        shift[group] -= rotation[group] @ offset
    return RigidMotion(label, rotation, shift)


def _carried(position, known, member, frame, sign, start):
    """The frame from which the group is carried to `frame`, and how it moves."""
    before = frame - sign
    shared = member[known[member, before] & known[member, frame]]
    for hop in HOPS:
        source = frame - sign * hop
        if (source - start) * sign < 0:
            continue
        common = member[known[member, source] & known[member, frame]]
        if len(common) >= SHARED_POINTS and len(common) > SHARED_SHARE * len(shared):
            return source, procrustes(position[common, source], position[common, frame])
    if len(shared) >= FEWEST:
        return before, procrustes(position[shared, before], position[shared, frame])
    move = np.zeros(3)
    if len(shared):
        move = np.median(position[shared, frame] - position[shared, before], axis=0)
    return before, (np.eye(3), move)


def procrustes(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and shift that take points nearest to others, robustly (Kabsch 1976).

    [3, 3] and [3], so that `target` is near rotation `source` + shift; both are
    [points, 3] in the same unit.
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
    """Where each path is in the canonical frame, and each group's middle there.

    [paths, 3] and [groups, 3], medians, in scene units as `position` [paths, frames,
    3]; `known` [paths, frames].
    """
    canonical = np.zeros((len(position), 3))
    for row, group in enumerate(bodies.label):
        at = np.flatnonzero(known[row])
        back = position[row, at] - bodies.shift[group, at]
        turned = np.einsum("tji,tj->ti", bodies.rotation[group, at], back)
        canonical[row] = np.median(turned, axis=0)
    middle = np.zeros((len(bodies.rotation), 3))
    for group in np.unique(bodies.label):
        middle[group] = np.median(canonical[bodies.label == group], axis=0)
    return canonical, middle


def miss(position: np.ndarray, known: np.ndarray, count: int) -> float:
    """How far `count` groups miss the known places in the median, scene units.

    `position` [paths, frames, 3] scene units, `known` [paths, frames].
    """
    label = labels(position, known, count)
    bodies = motion(position, known, label, position.shape[1] // 2)
    canonical, _ = centers(position, known, bodies)
    moved = np.einsum("ptij,pj->pti", bodies.rotation[label], canonical)
    away = np.linalg.norm(moved + bodies.shift[label] - position, axis=-1)
    return float(np.median(away[known]))


def fewest(
    position: np.ndarray, known: np.ndarray, within: float, most: int = 8
) -> tuple[int, float]:
    """How many groups, up to `most`, explain the paths, and by how much they miss.

    The fewest whose motions miss the known places by less than `within` in the median;
    `most` where that many do not. In scene units, as `position` [paths, frames, 3];
    `known` [paths, frames].
    """
    for count in range(1, most + 1):
        typical = miss(position, known, count)
        if typical < within:
            break
    return count, typical


def enough(
    position: np.ndarray, known: np.ndarray, counts: Sequence[int], share: float
) -> int:
    """The first of rising `counts` of groups beyond which more explain hardly more.

    By how far they miss the known places in the median: less than one group does, by
    at least `share` (0 to 1) of what the last of `counts` wins. `position` [paths,
    frames, 3] scene units, `known` [paths, frames].
    """
    one, last = (miss(position, known, count) for count in (1, counts[-1]))
    limit = one - share * max(one - last, 0.0)
    return next(
        n for n in counts if n == counts[-1] or miss(position, known, n) <= limit
    )


def rotation_vectors(rotation: np.ndarray, canonical: int) -> np.ndarray:
    """[groups, frames, 3] rad, smooth over time: turns beyond half a turn go on."""
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
    """[groups, frames, width] with the jitter of single frames taken out."""
    return nd.gaussian_filter1d(track, SMOOTHED_FRAMES, axis=1)
