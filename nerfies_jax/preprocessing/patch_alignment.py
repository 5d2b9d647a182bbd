"""Alignment of moving points with the image in which they begin, by warped patches.

`tracks.realigned` translates a patch, but moving objects also turn and change size. Its
errors then look like motion along the rays, because the depth of a rigid object follows
from its size in the images. Here a patch has the affine warp of the tracks around it,
which is that of a plane at some distance. Median errors of tracks and of the depth of
their objects in built-in scenes, `default` (cube) and `articulated` (forearm), three
camera paths each:
    translated                  0.34 px          0.39 px, 1.7 to 3.0 %
    turned and scaled           0.26 px, 0.5 %   0.18 px, 0.7 to 1.1 %
    affine                      0.21 px, 0.3 %
    affine, and once more       0.17 px, 0.2 %   0.13 px
These began from positions aligned by translation, of which few remain where an object
turns. From positions chained by flow, each with the correction of the frame before, the
cube has 0.12 px instead of 0.18, and the arm 0.15 and 0.19 px with four times as many
positions (one camera path).
"""

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from nerfies_jax.preprocessing.tracks import PRECISION_PX, WINDOW_PX, Tracks

# Tracks that determine the warp, and the minimum. With fewer, a patch is only
# translated.
NEIGHBORS, FEWEST = 12, 4
ROBUST_ROUNDS, NOISE_PX = 4, 0.5  # of the similarity transform, and of the affine one
# Weight of the similarity transform, relative to the neighbors, which may be in a line.
SIMILAR = 0.05
STEP_PX = 0.75  # Longer corrections in a frame are wrong, and flow remains.
# Root mean square of differences below which patches are equal, and the correlation
# below which they are otherwise different. On the arm of scene `articulated`, 37 to
# 59 % of the positions with lower correlations are wrong by more than a pixel, but only
# 2 % of those above 0.95.
NOISE_LEVELS, LEAST_CORRELATION = 6.0, 0.8
PASSES = 3  # Later ones have the warps of the aligned tracks.
ROUNDS = 8  # of the search. With 20, errors are equal within 2 %.
# Squared ratio of the errors of gray levels, 10, and of flow, 0.25 enlarged pixels. A
# patch without texture, or along an edge, stays where flow leads. From 100 to 1600 the
# median error of the cube decreases from 0.120 to 0.117 px.
RIDGE = 1600.0


class Patches(NamedTuple):
    """Patches around points, in the images in which they begin."""

    value: np.ndarray  # [points, pixels] gray levels
    gradient: np.ndarray  # [points, pixels, 2] right and down
    inverse: np.ndarray  # [points, 2, 2] of the structure tensor


class Neighbors(NamedTuple):
    """Tracks around each of some tracks, relative to it, in two frames."""

    row: np.ndarray  # [rows] the track
    source: np.ndarray  # [rows, neighbors, 2] in the first frame, pixels
    target: np.ndarray  # [rows, neighbors, 2] in the other frame


def align(tracks: Tracks, images: np.ndarray, size: tuple[int, int]) -> Tracks:
    """Align moving points with their first images, by affine patches.

    This is the inverse compositional algorithm for a translation. The linear part of
    the warp is known from the tracks. Flow is a prior for the translation.

    Args:
      tracks: Tracks of moving points, chained by flow or aligned by translation.
      images: Enlarged images from `dense_flow.leveled`.
      size: Width and height in pixels of the images of the tracks.

    Returns:
      The tracks. Positions that do not resemble the patch are invisible.

    References:
      Baker and Matthews 2004.
    """
    for _ in range(PASSES):
        tracks = _align_once(tracks, images, images.shape[2] // size[0])
    return tracks


def _align_once(tracks, images, times):
    """Align tracks once, in images enlarged `times` times."""
    patches = _patches(tracks, images, times)
    pixel, visible = tracks.pixel.copy(), tracks.visible.copy()
    frames = np.arange(len(images))
    for sign in (1, -1):
        # From the start outward, with the correction of the frame before.
        correction = np.zeros((len(tracks.start), 2))
        for frame in frames[::sign]:
            around = []
            here = tracks.visible[:, frame] & (sign * (frame - tracks.start) > 0)
            for start in np.unique(tracks.start[here]):
                rows = np.flatnonzero(here & (tracks.start == start))
                around.append(_neighbors(tracks, rows, start, frame))
            if not around:
                continue
            row, warp = np.concatenate([each.row for each in around]), _warps(around)
            guess = (tracks.pixel[row, frame] + correction[row]) * times - 0.5
            own = Patches(*(part[row] for part in patches))
            place, fits = _search(
                images[frame].astype(np.float32), own, warp, guess, times
            )
            correction[row] += np.where(fits[:, None], place - guess, 0) / times
            pixel[row, frame] = np.where(fits[:, None], (place + 0.5) / times, 0)
            visible[row, frame] = fits
    return Tracks(tracks.start, pixel, visible)


def _grid(reach):
    """Return the offsets (x, y) of the pixels of a patch, [pixels, 2]."""
    side = np.arange(-reach, reach + 1.0)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


def _sample(image, place):
    """Interpolate an image at positions (x, y), [points, pixels]."""
    x, y = np.moveaxis(place.astype(np.float32), -1, 0)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _patches(tracks, images, times):
    points, reach = len(tracks.visible), WINDOW_PX // 2
    side = 2 * reach + 3  # with a margin for the gradient
    value = np.zeros((points, side**2), np.float32)
    for start in np.unique(tracks.start):
        rows = tracks.start == start
        center = tracks.pixel[rows, start] * times - 0.5
        image = images[start].astype(np.float32)
        value[rows] = _sample(image, center[:, None] + _grid(reach + 1))
    value = value.reshape(points, side, side)
    right = 0.5 * (value[:, 1:-1, 2:] - value[:, 1:-1, :-2])
    down = 0.5 * (value[:, 2:, 1:-1] - value[:, :-2, 1:-1])
    gradient = np.stack([right, down], axis=-1).reshape(points, WINDOW_PX**2, 2)
    tensor = gradient.swapaxes(1, 2) @ gradient
    inverse = np.linalg.inv(tensor + RIDGE * np.eye(2))
    value = value[:, 1:-1, 1:-1].reshape(points, WINDOW_PX**2)
    return Patches(value, gradient, inverse)


def _search(image, patches, warp, guess, times):
    """Return the positions in an enlarged image at which warped patches fit best.

    Also returns if the image resembles the patches there.
    """
    place, active = guess.copy(), np.arange(len(guess))
    warp = warp.swapaxes(1, 2)  # of row vectors
    offset = (_grid(WINDOW_PX // 2) @ warp).astype(np.float32)
    inverse_warp = np.linalg.inv(warp)
    for _ in range(ROUNDS):
        at = place[active]
        error = _sample(image, at[:, None].astype(np.float32) + offset[active])
        error -= patches.value[active]
        slope = error[:, None] @ patches.gradient[active]
        away = (at - guess[active])[:, None] @ inverse_warp[active]
        step = (slope + RIDGE * away) @ patches.inverse[active] @ warp[active]
        step = np.clip(step[:, 0], -times, times)  # a pixel at once
        place[active] = at - step
        active = active[np.abs(step).max(1) > PRECISION_PX]
        if not len(active):
            break
    is_far = np.linalg.norm(place - guess, axis=-1) > STEP_PX * times
    place[is_far] = guess[is_far]
    value = _sample(image, place[:, None] + offset)
    return place, _are_alike(value, patches.value)


def _are_alike(value, other):
    """Test if patches are equal up to noise, or correlated, [points]."""
    equal = np.sqrt(((value - other) ** 2).mean(1)) < NOISE_LEVELS
    value = value - value.mean(1, keepdims=True)
    other = other - other.mean(1, keepdims=True)
    size = np.sqrt((value**2).sum(1) * (other**2).sum(1))
    return equal | ((value * other).sum(1) > LEAST_CORRELATION * size)


def _neighbors(tracks, rows, start, frame):
    """Return the tracks that are nearest to some of the same start in its frame."""
    common = np.flatnonzero(tracks.visible[:, start] & tracks.visible[:, frame])
    if len(common) <= FEWEST:
        return Neighbors(rows, *np.zeros((2, len(rows), 0, 2)))
    before, after = (
        tracks.pixel[:, each].astype(np.float64) for each in (start, frame)
    )
    count = min(NEIGHBORS, len(common) - 1)
    _, near = cKDTree(before[common]).query(before[rows], count + 1)
    source = before[common[near]] - before[rows, None]
    target = after[common[near]] - after[rows, None]
    return Neighbors(rows, source, target)


def _warps(around):
    """Return the affine warps around tracks from their first frame, [rows, 2, 2].

    They are robust least-squares fits to the neighbors.
    """
    ends = np.cumsum([0, *(len(each.row) for each in around)])
    counts = np.array([each.source.shape[1] for each in around])
    warps = np.tile(np.eye(2), (ends[-1], 1, 1))
    for count in np.unique(counts[counts > 0]):  # at once, because each part is small
        own = np.flatnonzero(counts == count)
        source, target = (
            np.concatenate([around[each][side] for each in own]) for side in (1, 2)
        )
        rows = np.concatenate([np.arange(*ends[each : each + 2]) for each in own])
        warps[rows] = _fitted_warps(source, target)
    return warps


def _fitted_warps(source, target):
    weight = np.ones(source.shape[:2])
    for _ in range(ROBUST_ROUNDS):
        similar = _similarities(weight, source, target)
        weight = _robust_weights(similar, source, target)
    for _ in range(ROBUST_ROUNDS):
        warp = _affine(weight, source, target, similar)
        weight = _robust_weights(warp, source, target)
    return warp


def _similarities(weight, source, target):
    """Return rotations with scales that lead from source to target, [rows, 2, 2]."""
    size = np.maximum((weight * (source**2).sum(-1)).sum(1), 1e-12)
    cosine = (weight * (source * target).sum(-1)).sum(1) / size
    cross = source[..., 0] * target[..., 1] - source[..., 1] * target[..., 0]
    sine = (weight * cross).sum(1) / size
    return np.stack([cosine, -sine, sine, cosine], axis=-1).reshape(-1, 2, 2)


def _affine(weight, source, target, similar):
    """Return linear maps from source to target near the similarities, [rows, 2, 2]."""
    weighted_source = weight[..., None] * source
    gram = source.swapaxes(1, 2) @ weighted_source
    cross = target.swapaxes(1, 2) @ weighted_source
    prior = 0.5 * SIMILAR * np.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-9
    return (cross + prior * similar) @ np.linalg.inv(gram + prior * np.eye(2))


def _robust_weights(warp, source, target):
    """Return weights of neighbors by their distance from the warp (Cauchy)."""
    miss = np.linalg.norm(target - source @ warp.swapaxes(1, 2), axis=-1)
    typical = NOISE_PX + np.median(miss, axis=1, keepdims=True)
    return 1 / (1 + (miss / typical) ** 2)
