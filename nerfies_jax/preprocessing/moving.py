"""Segmentation of moving tracks, and of moving pixels by the tracks."""

import cv2
import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from nerfies_jax.preprocessing import rest_points
from nerfies_jax.preprocessing.rest_points import RestPoints
from nerfies_jax.preprocessing.tracks import Tracks, pixel_of
from nerfies_jax.preprocessing.view_set import Views

# A track has a score of one half at this reprojection error of its static point.
HALF_CERTAIN_PX, STEEPNESS = 0.5, 3.0
# Cameras of real videos have errors of about a pixel, so the error above is at least
# this multiple of the error of the best quarter of the tracks. Without it, 21 % of a
# video of a hand in front of books are classified as moving, with it 7 % (the hand).
STILLEST, OVER_NOISE = 0.25, 3.0
# Tracks that are near each other in common frames have similar scores.
NEIGHBORS, EVERY_FRAMES, NEAR_PX, NEIGHBOR_WEIGHT, ROUNDS = 10, 6, 6.0, 3.0, 10
# The score of a pixel is that of tracks at similar positions and colors. Pixels far
# from all tracks may belong to objects that are too fast, so colors of the static scene
# decide.
VOTES, VOTE_PX, VOTE_COLOR, REACH_PX = 8, 4.0, 20.0, 8.0
VOTE_STEP = 2  # side of blocks of pixels with a common vote, which is smoothed later
FAR_FROM_TRACKS = 0.3
# Pixels that may move are excluded from the static scene that images are compared with.
OPEN, RIM_PX = 0.3, 8
SUREST = 0.02  # lower bound of the distance of votes from 0 and 1
SMOOTH_REACH, SMOOTH_PX, SMOOTH_COLOR = 4, 3.0, 15.0


def track_scores(
    tracks: Tracks, rest: RestPoints, noise_tracks: int | None = None
) -> np.ndarray:
    """Estimate the confidence that each track moves.

    Args:
      tracks: The tracks.
      rest: The static points that fit them best.
      noise_tracks: Number of tracks, the first ones, that begin anywhere and determine
        the noise. None for all.

    Returns:
      Scores in [0, 1], [tracks].
    """
    count = len(tracks.visible)
    if count == 0:
        return np.zeros(0)
    far = rest_points.miss(rest)
    half = max(HALF_CERTAIN_PX, OVER_NOISE * np.quantile(far[:noise_tracks], STILLEST))
    with np.errstate(divide="ignore"):
        odds = STEEPNESS * np.log(np.maximum(far, 1e-3) / half)
    probability = 1 / (1 + np.exp(-np.minimum(odds, 50)))
    alike = _neighborhood(tracks)
    total = np.asarray(alike.sum(1)).ravel() + 1e-9
    score = probability
    for _ in range(ROUNDS):
        around = alike @ score / total
        score = (probability + NEIGHBOR_WEIGHT * around) / (1 + NEIGHBOR_WEIGHT)
    return score


def _neighborhood(tracks):
    """Return the proximity of tracks in common frames, sparse [tracks, tracks]."""
    rows, columns, weights = [], [], []
    for frame in range(0, tracks.visible.shape[1], EVERY_FRAMES):
        here = np.flatnonzero(tracks.visible[:, frame])
        if len(here) <= NEIGHBORS:
            continue
        place = tracks.pixel[here, frame]
        distance, near = cKDTree(place).query(place, NEIGHBORS + 1)
        rows.append(np.repeat(here, NEIGHBORS))
        columns.append(here[near[:, 1:]].ravel())
        weights.append(np.exp(-0.5 * (distance[:, 1:] / NEAR_PX) ** 2).ravel())
    shape = (len(tracks.visible),) * 2
    if not rows:
        return sparse.csr_matrix(shape)
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    one_way = sparse.csr_matrix(entries, shape=shape)
    return one_way + one_way.T


def votes(views: Views, tracks: Tracks, score: np.ndarray) -> np.ndarray:
    """Estimate the probability that a pixel moves, from the tracks near it.

    Nearby tracks on pixels of similar color have the largest weights. A pixel far from
    all tracks has `FAR_FROM_TRACKS`.

    Args:
      views: The frames.
      tracks: The tracks.
      score: Their scores, [tracks].

    Returns:
      Probabilities, [frames, height, width].
    """
    frames = len(views.row)
    width, height = views.size
    x, y = np.meshgrid(np.arange(0, width, VOTE_STEP), np.arange(0, height, VOTE_STEP))
    at = np.stack([x, y], axis=-1).reshape(-1, 2)
    shares = np.full((frames, height, width), FAR_FROM_TRACKS, np.float32)
    for frame in range(frames):
        rows = np.flatnonzero(tracks.visible[:, frame])
        if len(rows) < VOTES:
            continue
        color = _lab(views, frame)
        place = tracks.pixel[rows, frame]
        row, column = pixel_of(place, (height, width))
        theirs = color[:, row, column]
        distance, near = cKDTree(place).query(at + 0.5 * VOTE_STEP, VOTES)
        distance = (distance / image_scale(width)).astype(np.float32)
        unlike = _squares(color[:, at[:, 1], at[:, 0], None] - theirs[:, near])
        unlike /= VOTE_COLOR**2
        weight = np.exp(-0.5 * ((distance / VOTE_PX) ** 2 + unlike))
        weight += 1e-9 * np.exp(-distance / VOTE_PX)
        share = (weight * score[rows][near]).sum(1) / weight.sum(1)
        share[distance[:, 0] > REACH_PX] = FAR_FROM_TRACKS
        share = share.reshape(x.shape)
        share = share.repeat(VOTE_STEP, 0).repeat(VOTE_STEP, 1)
        shares[frame] = share[:height, :width]
    return shares


def may_move(share: np.ndarray) -> np.ndarray:
    """Find all pixels that may move, with a margin.

    Args:
      share: Probabilities, [frames, height, width].

    Returns:
      Booleans, [frames, height, width].
    """
    size = 2 * round(RIM_PX * image_scale(share.shape[2])) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    seeds = (share > OPEN).astype(np.uint8)
    return np.stack([cv2.dilate(one, disc) > 0 for one in seeds])


def mask(views: Views, share: np.ndarray, odds: np.ndarray) -> np.ndarray:
    """Combine votes and colors to a mask, smoothed over pixels of similar color.

    Args:
      views: The frames.
      share: Probabilities from `votes`, [frames, height, width].
      odds: Log odds from `photo_consistency.log_odds`, [frames, height, width].

    Returns:
      Booleans, [frames, height, width].
    """
    share = np.clip(share, SUREST, 1 - SUREST)
    total = np.log(share / (1 - share)) + odds
    moving = np.zeros(total.shape, bool)
    for frame, one in enumerate(total):
        moving[frame] = _smooth(one.astype(np.float32), _lab(views, frame)) > 0
    return moving


def _lab(views, frame):
    """Return the CIELAB color of a frame, [3, height, width]."""
    lab = cv2.cvtColor(views.image[frame], cv2.COLOR_RGB2LAB)
    return np.ascontiguousarray(np.moveaxis(lab, -1, 0), np.float32)


def _squares(difference):
    """Return squared lengths of vectors along the first axis."""
    first, second, third = difference
    return first * first + second * second + third * third


def settled(tracks: Tracks, score: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Limit the scores of tracks to the share of their frames on moving pixels.

    Flow moves static pixels along with moving edges. In the built-in scenes these are
    up to a fifth of the tracks classified as moving, and hardly any after this step.

    Args:
      tracks: The tracks.
      score: Their scores, [tracks].
      moving: True for moving pixels, [frames, height, width].

    Returns:
      Scores, [tracks].
    """
    return np.minimum(score, share_on(tracks, moving))


def share_on(tracks: Tracks, moving: np.ndarray) -> np.ndarray:
    """Compute the share of its frames in which each track lies on moving pixels.

    Args:
      tracks: The tracks.
      moving: True for moving pixels, [frames, height, width].

    Returns:
      Shares, [tracks].
    """
    row, column = pixel_of(tracks.pixel, moving.shape[1:])
    on = moving[np.arange(len(moving)), row, column] & tracks.visible
    return on.sum(1) / np.maximum(tracks.visible.sum(1), 1)


def _smooth(values, color):
    """Apply a bilateral filter: average nearby pixels of similar color [3, h, w]."""
    height, width = values.shape
    own = color
    values, *planes = (
        cv2.copyMakeBorder(plane, *(SMOOTH_REACH,) * 4, cv2.BORDER_REFLECT)
        for plane in (values, *color)
    )
    color = np.stack(planes)
    total, weights = np.zeros((2, height, width), np.float32)
    reach = range(-SMOOTH_REACH, SMOOTH_REACH + 1)
    for down, right in ((i, j) for i in reach for j in reach if (i + j) % 2 == 0):
        there = np.s_[
            SMOOTH_REACH + down : SMOOTH_REACH + down + height,
            SMOOTH_REACH + right : SMOOTH_REACH + right + width,
        ]
        unlike = _squares(color[:, *there] - own) / SMOOTH_COLOR**2
        near = (down**2 + right**2) / SMOOTH_PX**2
        weight = np.exp(-0.5 * (unlike + np.float32(near)))
        total += weight * values[there]
        weights += weight
    return total / weights


def image_scale(width: int) -> float:
    """Return the factor for constants that were tuned at a width of 176 pixels.

    Args:
      width: Width of the image in pixels.

    Returns:
      The factor, at least 1.
    """
    return max(1.0, width / 176)
