"""Which tracks move by themselves, and with them which pixels."""

import cv2
import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from nerfies_jax.evidence.rest_points import RestPoints
from nerfies_jax.evidence.tracks import Tracks, pixel_of
from nerfies_jax.evidence.view_set import Views

# A track is as far off a point at rest as in the frames where it is worst but for three
# of ten; half a pixel of that counts as half certain.
QUANTILE, HALF_CERTAIN_PX, STEEPNESS = 0.7, 0.5, 3.0
# Cameras of real films are off by a pixel themselves: at least so many times what the
# stillest quarter of the tracks is off. Without it 55 % of a film of a hand before
# books counted as moving, with it 12 %: the hand.
STILLEST, OVER_NOISE = 0.25, 3.0
# Tracks near each other in shared frames move alike.
NEIGHBOURS, EVERY_FRAMES, NEAR_PX, NEIGHBOUR_WEIGHT, ROUNDS = 10, 6, 6.0, 3.0, 10
# A pixel takes after the tracks around it, by place and colour.
VOTES, VOTE_PX, VOTE_COLOUR, REACH_PX = 8, 4.0, 20.0, 8.0
LONGEST_SIDE_PX = 256  # masks of larger pictures are made this small and enlarged


def track_scores(tracks: Tracks, rest: RestPoints) -> np.ndarray:
    """[tracks] in 0..1: how certainly each moves by itself."""
    count = len(tracks.seen)
    if count == 0:
        return np.zeros(0)
    far = np.nanquantile(rest.residual, QUANTILE, axis=1)
    half = max(HALF_CERTAIN_PX, OVER_NOISE * np.quantile(far, STILLEST))
    with np.errstate(divide="ignore"):
        odds = STEEPNESS * np.log(np.maximum(far, 1e-3) / half)
    own = 1 / (1 + np.exp(-np.minimum(odds, 50)))
    alike = _neighbourhood(tracks)
    total = np.asarray(alike.sum(1)).ravel() + 1e-9
    score = own
    for _ in range(ROUNDS):
        around = alike @ score / total
        score = (own + NEIGHBOUR_WEIGHT * around) / (1 + NEIGHBOUR_WEIGHT)
    return score


def _neighbourhood(tracks):
    """[tracks, tracks] sparse: how near tracks are in frames that see both."""
    rows, columns, weights = [], [], []
    for frame in range(0, tracks.seen.shape[1], EVERY_FRAMES):
        here = np.flatnonzero(tracks.seen[:, frame])
        if len(here) <= NEIGHBOURS:
            continue
        place = tracks.pixel[here, frame]
        distance, near = cKDTree(place).query(place, NEIGHBOURS + 1)
        rows.append(np.repeat(here, NEIGHBOURS))
        columns.append(here[near[:, 1:]].ravel())
        weights.append(np.exp(-0.5 * (distance[:, 1:] / NEAR_PX) ** 2).ravel())
    shape = (len(tracks.seen),) * 2
    if not rows:
        return sparse.csr_matrix(shape)
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    one_way = sparse.csr_matrix(entries, shape=shape)
    return one_way + one_way.T


def mask(views: Views, tracks: Tracks, score: np.ndarray) -> np.ndarray:
    """[frames, height, width] bool: pixels whose nearest tracks move.

    Tracks that lie near and on a pixel of like colour count most; a pixel far from all
    of them counts as still.
    """
    frames = len(views.row)
    (width, height), part = views.size, _reduction(views)
    x, y = np.meshgrid(np.arange(0, width, part), np.arange(0, height, part))
    at = np.stack([x, y], axis=-1).reshape(-1, 2)
    found = np.zeros((frames, height, width), bool)
    for frame in range(frames):
        here = np.flatnonzero(tracks.seen[:, frame])
        if len(here) < VOTES:
            continue
        colour = cv2.cvtColor(views.image[frame], cv2.COLOR_RGB2LAB).astype(np.float32)
        own = colour[at[:, 1], at[:, 0]]
        place = tracks.pixel[here, frame]
        theirs = colour[pixel_of(place, (height, width))]
        distance, near = cKDTree(place).query(at + 0.5 * part, VOTES)
        distance = distance / picture_scale(width)
        unlike = np.linalg.norm(own[:, None] - theirs[near], axis=-1) / VOTE_COLOUR
        weight = np.exp(-0.5 * ((distance / VOTE_PX) ** 2 + unlike**2))
        weight = weight + 1e-9 * np.exp(-distance / VOTE_PX)
        votes = (weight * score[here][near]).sum(1) / weight.sum(1)
        votes[distance[:, 0] > REACH_PX] = 0
        small = votes.reshape(x.shape).astype(np.float32)
        found[frame] = cv2.resize(small, (width, height)) > 0.5
    return found


def picture_scale(width: int) -> float:
    """Pixels of such a picture for one of 176 wide, where the constants were set."""
    return max(1.0, width / 176)


def _reduction(views):
    return max(1, round(max(views.size) / LONGEST_SIDE_PX))
