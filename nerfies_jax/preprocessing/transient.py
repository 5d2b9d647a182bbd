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
    gone, carried = _jumps(views, evidence.flow)
    apart = float((carried < LEAST_CARRIED).mean())
    if apart > MOST_APART:
        return cannot_tell(
            EFFECT,
            f"{apart:.0%} of the neighboring frames are too different to detect "
            "objects that disappear",
            threshold,
        )
    gone = gone[carried >= LEAST_CARRIED]
    if len(gone) <= 2 * MIN_TIMES:
        return cannot_tell(EFFECT, f"only {len(gone)} pairs of frames", threshold)
    # The losses of the other pairs are the noise level.
    usual = float(np.sort(gone)[: -2 * MIN_TIMES].mean())
    worst = np.sort(_above_neighbors(gone))[::-1]
    wanted, confidence = judge(float(worst[MIN_TIMES - 1]), GONE_SHARE, usual)
    times = int((worst > GONE_SHARE).sum())
    if wanted is False and not _always_there(evidence):
        return cannot_tell(
            EFFECT,
            "nothing appears or disappears abruptly, but moving objects are visible in "
            "less than half of the frames",
            threshold,
        )
    measurement = (
        f"parts of the image appear or disappear in {times} of {len(gone)} pairs of "
        f"frames (at most {worst[0]:.1%} of the pixels, usually {usual:.2%})"
    )
    numbers = {
        "times": float(times),
        "largest_share": float(worst[0]),
        "usual_share": usual,
    }
    return Finding(EFFECT, measurement, threshold, wanted, confidence, numbers)


def _above_neighbors(gone):
    """Return the losses of pairs above the median of their neighbors."""
    above = []
    for at, one in enumerate(gone):
        beside = np.r_[gone[max(0, at - AROUND) : at], gone[at + 1 : at + 1 + AROUND]]
        above.append(max(0.0, one - float(np.median(beside))) if len(beside) else 0.0)
    return np.array(above)


def _always_there(evidence):
    """Test if something moves in most frames, or in none."""
    there = motion.frame_shares(evidence) > motion.MOVING_SHARE
    return there.mean() > 0.5 or not there.any()


def _jumps(views: Views, flow: NeighborFlow) -> tuple[np.ndarray, np.ndarray]:
    """Compute the share of pixels that only one of two neighboring frames shows."""
    part = view_set.times_smaller(views)
    textured = views.textured[:-1] & flow.forward_seen[:-1]
    carried = textured.sum((1, 2)) / np.maximum(views.textured[:-1].sum((1, 2)), 1)
    views = view_set.smaller(views, part)
    images = [_leveled(gray) for gray in views.gray]
    shares = []
    for one in range(len(views.row) - 1):
        there = _way(flow.forward[one], flow.forward_seen[one], part)
        back = _way(flow.backward[one + 1], flow.backward_seen[one + 1], part)
        shares.append(
            min(
                _gone(views, images, (one, one + 1), there, back.flow),
                _gone(views, images, (one + 1, one), back, there.flow),
            )
        )
    return np.array(shares), carried


class _Way(NamedTuple):
    """Flow from one frame to another, and the search range for pixels without it.

    Only consistent flow is used, since the flow of vanished pixels is arbitrary.
    """

    flow: np.ndarray  # [height, width, 2] px
    shift: np.ndarray  # [2] px, the camera's own turn: the median
    reach: int  # px around it


def _way(flow, valid, part):
    """Return the flow and search range in pixels of reduced images."""
    flow = dense_flow.reduced(flow, part)
    valid = cv2.resize(np.uint8(valid), flow.shape[1::-1]) > 0
    usual = flow[valid] if valid.any() else flow.reshape(-1, 2)
    shift = np.median(usual, axis=0)
    off = np.linalg.norm(usual - shift, axis=-1)
    low, high = (share * flow.shape[1] for share in REACH_SHARES)
    reach = round(float(np.clip(2 * np.quantile(off, 0.9), low, high)))
    return _Way(flow, shift, reach)


def _leveled(gray):
    """Subtract the local mean of an image and normalize its contrast."""
    detail = gray - cv2.GaussianBlur(gray, (0, 0), LOCAL_PX)
    spread = np.sqrt(np.mean(detail**2))
    return detail / (5 * spread) if spread > 0 else detail


def _gone(views, images, pair, there, back):
    """Return the share of pixels of a frame that are not visible in another one."""
    image, target = (images[index] for index in pair)
    lost = _lost(views, pair[0], image, target, there, back)
    tried = np.argwhere(lost & views.textured[pair[0]])
    if not len(tried):
        return 0.0
    rng = np.random.default_rng(pair[0])
    if len(tried) > MOST_PATCHES:
        tried = tried[rng.choice(len(tried), MOST_PATCHES, replace=False)]
    shift = there.shift.round().astype(int)
    missing = sum(
        not _found(image, target, line, column, shift, there.reach)
        for line, column in tried
    )
    return float(lost.mean() * missing / len(tried))


def _lost(views, index, image, target, there, back):
    """Find pixels [height, width] without a match that should be in the other frame."""
    width, height = views.size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    end = np.moveaxis(grid + there.flow, -1, 0).astype(np.float32)
    led_back, color = (
        cv2.remap(one, *end, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for one in (back, target)
    )
    gap = np.linalg.norm(there.flow + led_back, axis=-1)
    open_end = gap > LOST_PX + LOST_SHARE * np.linalg.norm(there.flow, axis=-1)
    changed = cv2.GaussianBlur(np.abs(image - color), (0, 0), 1.5) > LOST_COLOR
    # Pixels may leave the image by the common shift, or by the larger shift of near
    # objects, and need a margin for the patch.
    rim = PATCH + there.reach
    common = grid + there.shift
    bound = np.array([width - 1, height - 1]) - rim
    stays = ((common >= rim) & (common <= bound)).all(-1)
    bound = np.array([width - 1, height - 1]) - PATCH
    stays &= ((grid >= PATCH) & (grid <= bound)).all(-1)
    lost = (open_end | changed) & stays & views.valid[index]
    return nd.binary_opening(lost, iterations=max(1, round(OPENED_SHARE * width)))


def _found(image, target, line, column, shift, reach):
    patch = image[line - PATCH : line + PATCH + 1, column - PATCH : column + PATCH + 1]
    span = reach + PATCH
    middle = line + shift[1], column + shift[0]
    low = [max(0, at - span) for at in middle]
    window = target[low[0] : middle[0] + span + 1, low[1] : middle[1] + span + 1]
    if min(window.shape) < 2 * PATCH + 1:
        return True  # outside of the image, so not decidable
    return bool(skimage.feature.match_template(window, patch).max() > ALIKE)
