"""Transient objects: visible in one frame, and nowhere in the next.

A moving object is still nearby in the next frame, and one that emerges from behind
another appears as a strip. An object that is not part of the scene, in photographs or
edited video, appears or disappears suddenly.
"""

from typing import NamedTuple

import cv2
import numpy as np
import scipy.ndimage as nd
import skimage.feature

from nerfies_jax.preprocessing import dense_flow, motion, view_set
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.findings import TRANSIENT as EFFECT
from nerfies_jax.preprocessing.findings import Finding, cannot_tell, judge
from nerfies_jax.preprocessing.record import Evidence
from nerfies_jax.preprocessing.view_set import Views

LOST_PX, LOST_SHARE = 1.0, 0.1  # forward and back must meet, of the way
LOST_COLOR = 0.1  # half the contrast of an image whose deviation is a fifth
OPENED_SHARE = 3 / 176  # of the image's width: no strips
PATCH = 5  # pixels to each side
REACH_SHARES = (0.05, 0.15)  # of the width: how far what was lost is looked for
AROUND = 3  # pairs before and after: what jumps stands out among them
ALIKE = 0.7  # correlation of a patch with where it is found again
MOST_PATCHES = 40  # looked for, of a frame
# Share of the pixels of both frames, beyond the losses of pairs around. Built-in scenes
# without transient objects lose up to 1.9 % once and 1.4 % twice, at 60 and 40 frames.
GONE_SHARE = 0.03
MIN_TIMES = 2  # it came and it went
# Pairs of frames that carry less show other things to begin with, as photographs do and
# the last and first of cameras that take turns: they say nothing, and where more than
# so many are like that, neither does the video.
LEAST_CARRIED, MOST_APART = 0.4, 0.1
LOCAL_PX = 12  # deviation of the local mean


def transient(views: Views, evidence: Evidence) -> Finding:
    """Decide if large parts of images appear and disappear from frame to frame.

    Args:
      views: The frames.
      evidence: Their preprocessing.

    Returns:
      The finding.
    """
    threshold = (
        f"{GONE_SHARE:.0%} of an image missing in the next frame, {MIN_TIMES} times"
    )
    if evidence.unusable:
        return cannot_tell(EFFECT, evidence.unusable, threshold)
    losses, flow_shares = _jumps(views, evidence.flow)
    apart = float((flow_shares < LEAST_CARRIED).mean())
    if apart > MOST_APART:
        return cannot_tell(
            EFFECT,
            f"{apart:.0%} of the neighboring frames are too different to detect "
            "objects that disappear",
            threshold,
        )
    losses = losses[flow_shares >= LEAST_CARRIED]
    if len(losses) <= 2 * MIN_TIMES:
        return cannot_tell(EFFECT, f"only {len(losses)} pairs of frames", threshold)
    # The losses of the other pairs are the noise level.
    usual = float(np.sort(losses)[: -2 * MIN_TIMES].mean())
    worst = np.sort(_above_neighbors(losses))[::-1]
    decision, confidence = judge(float(worst[MIN_TIMES - 1]), GONE_SHARE, usual)
    times = int((worst > GONE_SHARE).sum())
    if decision is False and not _always_there(evidence):
        return cannot_tell(
            EFFECT,
            "nothing appears or disappears abruptly, but moving objects are visible in "
            "less than half of the frames",
            threshold,
        )
    measurement = (
        f"parts of the image appear or disappear in {times} of {len(losses)} pairs of "
        f"frames (at most {worst[0]:.1%} of the pixels, usually {usual:.2%})"
    )
    numbers = {
        "times": float(times),
        "largest_share": float(worst[0]),
        "usual_share": usual,
    }
    return Finding(EFFECT, measurement, threshold, decision, confidence, numbers)


def _above_neighbors(losses):
    """Return the losses of pairs above the median of their neighbors."""
    above = []
    for at, loss in enumerate(losses):
        neighbors = np.r_[
            losses[max(0, at - AROUND) : at], losses[at + 1 : at + 1 + AROUND]
        ]
        above.append(
            max(0.0, loss - float(np.median(neighbors))) if len(neighbors) else 0.0
        )
    return np.array(above)


def _always_there(evidence):
    """Test if something moves in most frames, or in none."""
    there = motion.frame_shares(evidence) > motion.MOVING_SHARE
    return there.mean() > 0.5 or not there.any()


def _jumps(views: Views, flow: NeighborFlow) -> tuple[np.ndarray, np.ndarray]:
    """Compute the share of pixels that only one of two neighboring frames shows."""
    part = view_set.times_smaller(views)
    has_flow = views.textured[:-1] & flow.forward_valid[:-1]
    flow_shares = has_flow.sum((1, 2)) / np.maximum(views.textured[:-1].sum((1, 2)), 1)
    views = view_set.smaller(views, part)
    images = [_normalize_contrast(gray) for gray in views.gray]
    shares = []
    for index in range(len(views.row) - 1):
        there = _search_of(flow.forward[index], flow.forward_valid[index], part)
        back = _search_of(
            flow.backward[index + 1], flow.backward_valid[index + 1], part
        )
        shares.append(
            min(
                _measure_loss(views, images, (index, index + 1), there, back.flow),
                _measure_loss(views, images, (index + 1, index), back, there.flow),
            )
        )
    return np.array(shares), flow_shares


class _Search(NamedTuple):
    """Flow from one frame to another, and the search range for pixels without it.

    Only consistent flow is used, since the flow of vanished pixels is arbitrary.
    """

    flow: np.ndarray  # [height, width, 2] px
    shift: np.ndarray  # [2] px, the camera's own turn: the median
    reach: int  # px around it


def _search_of(flow, valid, part):
    """Return the flow and search range in pixels of reduced images."""
    flow = dense_flow.reduced(flow, part)
    valid = cv2.resize(np.uint8(valid), flow.shape[1::-1]) > 0
    usual = flow[valid] if valid.any() else flow.reshape(-1, 2)
    shift = np.median(usual, axis=0)
    off = np.linalg.norm(usual - shift, axis=-1)
    low, high = (share * flow.shape[1] for share in REACH_SHARES)
    reach = round(float(np.clip(2 * np.quantile(off, 0.9), low, high)))
    return _Search(flow, shift, reach)


def _normalize_contrast(gray):
    """Subtract the local mean of an image and normalize its contrast."""
    detail = gray - cv2.GaussianBlur(gray, (0, 0), LOCAL_PX)
    spread = np.sqrt(np.mean(detail**2))
    return detail / (5 * spread) if spread > 0 else detail


def _measure_loss(views, images, pair, there, back):
    """Return the share of pixels of a frame that are not visible in another one."""
    image, target = (images[index] for index in pair)
    lost_mask = _find_lost_pixels(views, pair[0], image, target, there, back)
    patches = np.argwhere(lost_mask & views.textured[pair[0]])
    if not len(patches):
        return 0.0
    rng = np.random.default_rng(pair[0])
    if len(patches) > MOST_PATCHES:
        patches = patches[rng.choice(len(patches), MOST_PATCHES, replace=False)]
    shift = there.shift.round().astype(int)
    missing = sum(
        not _has_match(image, target, line, column, shift, there.reach)
        for line, column in patches
    )
    return float(lost_mask.mean() * missing / len(patches))


def _find_lost_pixels(views, index, image, target, there, back):
    """Find pixels [height, width] without a match that should be in the other frame."""
    width, height = views.size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    end = np.moveaxis(grid + there.flow, -1, 0).astype(np.float32)
    flow_back, color = (
        cv2.remap(array, *end, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for array in (back, target)
    )
    gap = np.linalg.norm(there.flow + flow_back, axis=-1)
    open_end = gap > LOST_PX + LOST_SHARE * np.linalg.norm(there.flow, axis=-1)
    differs = cv2.GaussianBlur(np.abs(image - color), (0, 0), 1.5) > LOST_COLOR
    # Pixels may leave the image by the common shift, or by the larger shift of near
    # objects, and need a margin for the patch.
    rim = PATCH + there.reach
    common = grid + there.shift
    bound = np.array([width - 1, height - 1]) - rim
    stays = ((common >= rim) & (common <= bound)).all(-1)
    bound = np.array([width - 1, height - 1]) - PATCH
    stays &= ((grid >= PATCH) & (grid <= bound)).all(-1)
    lost_mask = (open_end | differs) & stays & views.valid[index]
    return nd.binary_opening(lost_mask, iterations=max(1, round(OPENED_SHARE * width)))


def _has_match(image, target, line, column, shift, reach):
    patch = image[line - PATCH : line + PATCH + 1, column - PATCH : column + PATCH + 1]
    span = reach + PATCH
    middle = line + shift[1], column + shift[0]
    low = [max(0, at - span) for at in middle]
    window = target[low[0] : middle[0] + span + 1, low[1] : middle[1] + span + 1]
    if min(window.shape) < 2 * PATCH + 1:
        return True  # outside of the image, so not decidable
    return bool(skimage.feature.match_template(window, patch).max() > ALIKE)
