"""Optical flow of regions that move too far between two frames for a local search.

Blocks and SIFT features are matched inside the pixels without consistent flow. RANSAC
groups the matches by affine maps, and each map warps the second image, so that a local
search finds the remaining flow. Quadratic polynomials fitted to consistent flow extend
it over the region.
"""

from typing import NamedTuple

import cv2
import numpy as np

from nerfies_jax.preprocessing import dense_flow, view_set, wide_steps
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.tracks import pixel_of
from nerfies_jax.preprocessing.view_set import Views

# Side of a block, distance between blocks, largest displacement, and largest error of a
# match, relative to the image width.
BLOCK_SHARE, STRIDE_SHARE, REACH_SHARE, MISS_SHARE = 0.09, 0.03, 0.25, 0.017
LEAST_LOST = 0.5  # minimum share of lost pixels in a block
# Lost pixels narrower than the first are ignored, and regions are enlarged by the
# second, relative to the width, since flow next to them is often wrong as well.
NARROW_SHARE, MARGIN_SHARE = 0.03, 0.025
LEAST_REGION = 0.005  # minimum area of a region relative to the image
FEATURE_RATIO, FEATURE_CONTRAST = 0.85, 0.02  # of SIFT
GROUPS = 3  # of matches for each pair of frames
FEWEST_MATCHES = 10
MOST_STRETCH, LEAST_STRETCH = 2.0, 0.4  # singular values of affine maps
# Minimum share of the lost pixels that must become consistent by a map, and by another
# round of its extension.
LEAST_GAIN, LEAST_ROUND_GAIN = 0.1, 0.02
ROUNDS, FIT_ROUNDS = 3, 6
BETTER = 0.9  # largest relative matching error for replacing consistent flow
SEARCHES = 24  # work for a pair of frames


class _Pair(NamedTuple):
    """Two neighboring frames, in both directions."""

    frames: tuple[int, int]
    images: tuple[np.ndarray, np.ndarray]  # as from `dense_flow.leveled`
    small: tuple[np.ndarray, np.ndarray]  # in the pixels of the views
    lost: tuple[np.ndarray, np.ndarray]  # regions without consistent flow


def pairs(views: Views, flow: NeighborFlow) -> list[int]:
    """Find the frames with a lost region in a large displacement to the next frame.

    Args:
      views: The frames.
      flow: Their flow.

    Returns:
      Indices of the first frames of the pairs.
    """
    least = LEAST_REGION * views.gray[0].size
    return [
        frame
        for frame in range(len(views.row) - 1)
        if wide_steps.is_wide(views, (frame, frame + 1), flow.forward[frame])
        and max(region.sum() for region in _find_regions(views, flow, frame)) > least
    ]


def recovered(
    views: Views, images: np.ndarray, flow: NeighborFlow, frames: list[int]
) -> NeighborFlow:
    """Search for the flow of lost regions.

    Args:
      views: The frames.
      images: Their images from `dense_flow.leveled`.
      flow: Their flow.
      frames: First frames of the pairs to search, from `pairs`.

    Returns:
      The flow, with more consistent pixels in these pairs.
    """
    flow = NeighborFlow(*(part.copy() for part in flow))
    times = images.shape[2] // views.size[0]
    search = dense_flow.dis(times)
    for frame in frames:
        frame_pair = frame, frame + 1
        small = (255 * views.gray[frame : frame + 2]).round().astype(np.uint8)
        pair = _Pair(
            frame_pair,
            (images[frame], images[frame + 1]),
            (small[0], small[1]),
            _find_regions(views, flow, frame),
        )
        for guesses in _affine_flows(views, pair):
            _extend(pair, flow, guesses, search)
        forward, backward = flow.forward[frame], flow.backward[frame + 1]
        flow.forward_valid[frame] = dense_flow.closed(forward, backward)
        flow.backward_valid[frame + 1] = dense_flow.closed(backward, forward)
    return flow


def _find_regions(views, flow, frame):
    """Return the regions without consistent flow of a frame and of the next one."""
    width = views.size[0]
    narrow, margin = (
        np.ones((2 * round(share * width / 2) + 1,) * 2, np.uint8)
        for share in (NARROW_SHARE, 2 * MARGIN_SHARE)
    )
    regions = []
    for index, consistent in (
        (frame, flow.forward_valid[frame]),
        (frame + 1, flow.backward_valid[frame + 1]),
    ):
        lost_mask = np.uint8(views.textured[index] & ~consistent)
        wide = cv2.morphologyEx(lost_mask, cv2.MORPH_OPEN, narrow)
        regions.append(cv2.dilate(wide, margin) > 0)
    return tuple(regions)


def _affine_flows(views, pair):
    """Return the flow in both directions of each group of matches."""
    there, back = (_matches(views, pair, *order) for order in ((0, 1), (1, 0)))
    source, target = (
        np.concatenate([there[0], back[1]]),
        np.concatenate([there[1], back[0]]),
    )
    width, height = views.size
    place = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1) + 0.5
    most = REACH_SHARE * width
    flows = []
    for _ in range(GROUPS):
        if len(source) < FEWEST_MATCHES:
            break
        affine, inlier = cv2.estimateAffine2D(
            source,
            target,
            ransacReprojThreshold=MISS_SHARE * width,
            maxIters=5000,
            confidence=0.9999,
        )
        if affine is None or inlier.sum() < FEWEST_MATCHES:
            break
        matrix, shift = affine[:, :2], affine[:, 2]
        stretch = np.linalg.svd(matrix, compute_uv=False)
        is_plausible = stretch[0] < MOST_STRETCH and stretch[1] > LEAST_STRETCH
        if is_plausible and np.linalg.det(matrix) > 0:
            ahead = place @ matrix.T + shift
            behind = (place - shift) @ np.linalg.inv(matrix).T
            flows.append([np.clip(at - place, -most, most) for at in (ahead, behind)])
        is_left = inlier.ravel() == 0
        source, target = source[is_left], target[is_left]
    return flows


def _matches(views, pair, source, target):
    """Return matching positions of two frames in pixels, [matches, 2] each."""
    blocks = _block_matches(views, pair, source, target)
    features = _feature_matches(views, pair, source, target)
    return [np.concatenate(parts) for parts in zip(blocks, features, strict=True)]


def _block_matches(views, pair, source, target):
    part = view_set.times_smaller(views)
    size = views.size[0] // part, views.size[1] // part
    image, other = (
        cv2.resize(views.image[pair.frames[at]], size, interpolation=cv2.INTER_AREA)
        for at in (source, target)
    )
    mask = cv2.resize(np.float32(pair.lost[source]), size, interpolation=cv2.INTER_AREA)
    half, reach = round(BLOCK_SHARE * size[0] / 2), round(REACH_SHARE * size[0])
    stride = max(round(STRIDE_SHARE * size[0]), 1)
    padded_image = cv2.copyMakeBorder(other, *(reach,) * 4, cv2.BORDER_REPLICATE)
    center, shift = [], []
    for y in range(half, size[1] - half + 1, stride):
        for x in range(half, size[0] - half + 1, stride):
            block = np.s_[y - half : y + half, x - half : x + half]
            if mask[block].mean() < LEAST_LOST:
                continue
            window = np.s_[
                y - half : y + half + 2 * reach, x - half : x + half + 2 * reach
            ]
            alike = cv2.matchTemplate(
                padded_image[window], image[block], cv2.TM_CCOEFF_NORMED
            )
            down, right = np.unravel_index(alike.argmax(), alike.shape)
            center.append((x, y))
            shift.append((right - reach, down - reach))
    center = part * np.array(center, float).reshape(-1, 2)
    return center, center + part * np.array(shift, float).reshape(-1, 2)


def _feature_matches(views, pair, source, target):
    times = pair.images[0].shape[1] // views.size[0]
    sift = cv2.SIFT_create(contrastThreshold=FEATURE_CONTRAST)
    features = [sift.detectAndCompute(pair.images[at], None) for at in (source, target)]
    place = [
        (np.array([point.pt for point in points], float).reshape(-1, 2) + 0.5) / times
        for points, _ in features
    ]
    no_matches = np.zeros((0, 2))
    if min(map(len, place)) < 2:
        return no_matches, no_matches
    near = cv2.BFMatcher().knnMatch(features[0][1], features[1][1], k=2)
    matches = [
        (best.queryIdx, best.trainIdx)
        for best, second in near
        if best.distance < FEATURE_RATIO * second.distance
    ]
    if not matches:
        return no_matches, no_matches
    first, second = np.array(matches).T
    start, end = place[0][first], place[1][second]
    region = pair.lost[source]
    is_lost = region[pixel_of(start, region.shape)]
    return start[is_lost], end[is_lost]


def _extend(pair, flow, guesses, search):
    """Search from a guess, and then from polynomials fitted to what it recovered."""
    area = sum(region.sum() for region in pair.lost)
    new = [np.zeros(region.shape, bool) for region in pair.lost]
    for number in range(ROUNDS + 1):
        candidates = [
            _refine(pair, order, guess, search)
            for order, guess in zip(((0, 1), (1, 0)), guesses, strict=True)
        ]
        better = _better(pair, flow, candidates)
        gain = sum(mask.sum() for mask in better) / max(area, 1)
        if gain < (LEAST_ROUND_GAIN if number else LEAST_GAIN):
            break
        guesses = []
        for at, (shift, consistent) in enumerate(_sides(flow, pair.frames[0])):
            shift[better[at]] = candidates[at][better[at]]
            consistent[better[at]] = True
            new[at] |= better[at]
            guesses.append(_extrapolate(shift, new[at], pair.lost[at]))


def _sides(flow, frame):
    """Return flow and its consistency, forward of a frame and backward of the next."""
    return (
        (flow.forward[frame], flow.forward_valid[frame]),
        (flow.backward[frame + 1], flow.backward_valid[frame + 1]),
    )


def _refine(pair, order, guess, search):
    """Search in the second image, warped by the guess, and add the guess."""
    image, target = (pair.images[at] for at in order)
    times = image.shape[1] // guess.shape[1]
    guess = dense_flow.enlarged_flow(guess.astype(np.float32), times)
    correction = search(image, _warp(target, guess))
    return dense_flow.reduced(correction + _warp(guess, correction), times)


def _warp(image, flow):
    height, width = flow.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height))
    at = x + flow[..., 0], y.astype(np.float32) + flow[..., 1]
    return cv2.remap(image, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _better(pair, flow, candidates):
    """Find the pixels of lost regions for which the candidates are better, by side."""
    masks = []
    for at, (shift, consistent) in enumerate(_sides(flow, pair.frames[0])):
        new, reverse = candidates[at], candidates[1 - at]
        small = pair.small[at], pair.small[1 - at]
        jump = dense_flow.JUMP_SHARE * new.shape[1]
        differs = np.linalg.norm(new - shift, axis=-1) > jump
        costs = [wide_steps.unlike(small, candidate) for candidate in (new, shift)]
        replaces = ~consistent | (differs & (costs[0] < BETTER * costs[1]))
        masks.append(pair.lost[at] & dense_flow.closed(new, reverse) & replaces)
    return masks


def _extrapolate(flow, is_known, region):
    """Extend known flow over a region by a quadratic polynomial."""
    height, width = is_known.shape
    y, x = (np.mgrid[:height, :width] - np.array([[[height]], [[width]]]) / 2) / width
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
    matrix, values = terms[is_known], flow[is_known]
    guess = flow.copy()
    if len(values) < 2 * matrix.shape[1]:
        return guess
    weight, soft = np.ones(len(values)), 0.5 * MISS_SHARE * width
    for _ in range(FIT_ROUNDS):
        root = np.sqrt(weight)[:, None]
        factors = np.linalg.lstsq(root * matrix, root * values, rcond=None)[0]
        miss = np.linalg.norm(matrix @ factors - values, axis=-1)
        weight = 1 / (1 + (miss / soft) ** 2)
    most = REACH_SHARE * width
    guess[region] = np.clip(terms[region] @ factors, -most, most)
    return guess
