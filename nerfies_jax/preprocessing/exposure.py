"""Exposure and color: test if static points have the same colors in all frames."""

import itertools

import cv2
import numpy as np

from nerfies_jax.capture.images import linear_from_srgb
from nerfies_jax.preprocessing import view_set
from nerfies_jax.preprocessing.findings import DEVIATIONS, Finding, cannot_tell, judge
from nerfies_jax.preprocessing.findings import LIGHT as EFFECT
from nerfies_jax.preprocessing.view_set import Views

# An uncorrected gain of a tenth of a stop (7 %, 3 % of a mean sRGB value of 0.5) limits
# the PSNR to 36 dB, which is above typical results.
DRIFT_STOPS = 0.1
GROUPS = 8  # of points by position. The gain of a frame is common to all groups.
MIN_POINTS = 40  # points in a frame and group
# Linear light between which a pixel measures gain: sRGB 15 of 255, where a level is
# 0.1 stop, to where highlights are clipped.
DARK, BRIGHT = 0.005, 0.9
POLISHES = 12  # rounds of medians; the gains move by less than 1e-3 afterwards


def exposure(views: Views, points: np.ndarray) -> Finding:
    """Decide if frames differ in brightness or color.

    Args:
      views: The frames.
      points: Static points in scene units, [points, 3].

    Returns:
      The finding.
    """
    threshold = f"{DRIFT_STOPS:g} stops, root mean square over frames and channels"
    if len(points) < GROUPS * MIN_POINTS:
        return cannot_tell(
            EFFECT,
            f"{len(points)} static points; {GROUPS * MIN_POINTS} are needed",
            threshold,
        )
    light = _sightings(view_set.smaller(views, view_set.times_smaller(views)), points)
    groups = np.array_split(np.argsort(_along_widest(points)), GROUPS)
    each = np.stack([_gains(light[:, group]) for group in groups])
    valid = np.isfinite(each).all(-1).sum(0) >= GROUPS // 2
    if valid.sum() < max(3, 0.5 * len(views.row)):
        return cannot_tell(
            EFFECT, f"only {valid.sum()} frames show enough static points", threshold
        )
    each = each[:, valid]
    drift, error = common_drift(each)
    common = np.nanmedian(each, axis=0)
    common = common - common.mean(0)
    brightness = float(np.sqrt(np.mean(common.mean(-1) ** 2)))
    tint = float(np.sqrt(np.mean((common - common.mean(-1, keepdims=True)) ** 2)))
    drifts, confidence = judge(drift, DRIFT_STOPS, error)
    evidence = (
        f"colors of static points differ by {drift:.3f} stops between frames "
        f"(brightness {brightness:.3f}, color {tint:.3f}), with an error of "
        f"{error:.3f}"
    )
    numbers = {
        "drift_stops": drift,
        "brightness_stops": brightness,
        "color_stops": tint,
        "noise_stops": error,
        "points": float(len(points)),
    }
    return Finding(EFFECT, evidence, threshold, drifts, confidence, numbers)


def common_drift(gain: np.ndarray) -> tuple[float, float]:
    """Estimate how much a gain common to all groups of points changes over time.

    Errors of different groups are independent, so the mean product of the gains of two
    groups is an unbiased estimate of the variance of the common gain, whatever the
    errors within a group and their correlation over time. The median over all pairs
    tolerates a group that a moving object hides.

    Args:
      gain: Gain of each group and frame in stops, [groups, frames, channels]. NaN where
        it is unknown.

    Returns:
      Root mean square of the common gain around its mean, in stops, and its standard
      error in the direction of `DRIFT_STOPS`, from a jackknife over the groups.
    """
    offset = gain - np.nanmean(gain, axis=1, keepdims=True)
    count = len(gain)
    products = np.full((count, count), np.nan)
    for first, second in itertools.combinations(range(count), 2):
        product = offset[first] * offset[second]
        if np.isfinite(product).any():
            products[first, second] = np.nanmean(product)
    variance = np.nanmedian(products)
    others = [np.delete(np.arange(count), index) for index in range(count)]
    without = [np.nanmedian(products[np.ix_(rows, rows)]) for rows in others]
    error = np.sqrt((count - 1) * np.var(without))
    drift = np.sqrt(max(variance, 0))
    sign = -1 if drift > DRIFT_STOPS else 1
    bound = np.sqrt(max(max(variance, 0) + sign * DEVIATIONS * error, 0))
    return float(drift), float(abs(bound - drift) / DEVIATIONS)


def _sightings(views: Views, points: np.ndarray) -> np.ndarray:
    """Measure the linear light of points in all frames."""
    light = np.full((len(views.row), len(points), 3), np.nan)
    for index in range(len(views.row)):
        pixel, depth = view_set.project(views, index, points)
        inside = view_set.in_image(views, pixel, depth, 2)
        image = linear_from_srgb(views.image[index] / 255)
        # A pixel's blur: points are known to a fraction of one.
        image = cv2.GaussianBlur(image, (0, 0), 1)
        place = pixel[inside]
        at = (place - 0.5).astype(np.float32)[:, None]
        # OpenCV takes one map of pairs, which its stubs do not know.
        value = cv2.remap(image, at, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        value = value[:, 0]
        visible = views.valid[index][tuple(place[:, ::-1].astype(int).T)]
        usable = ((value > DARK) & (value < BRIGHT)).all(-1) & visible
        light[index, inside] = np.where(usable[:, None], np.log2(value), np.nan)
    return light


def _gains(light: np.ndarray) -> np.ndarray:
    """Estimate the gain of each frame by median polish."""
    gain = np.zeros((len(light), 3))
    is_observed = np.isfinite(light).all(-1)
    enough = is_observed.sum(1) >= MIN_POINTS
    usable = (is_observed & enough[:, None]).sum(0) >= 2
    light = np.where(enough[:, None, None], light, np.nan)[:, usable]
    if not enough.any() or not usable.any():
        return np.full_like(gain, np.nan)
    rows = light[enough]
    for _ in range(POLISHES):
        color = np.nanmedian(rows - gain[enough][:, None], axis=0)
        gain[enough] = np.nanmedian(rows - color, axis=1)
        gain[enough] -= gain[enough].mean(0)
    gain[~enough] = np.nan
    return gain


def _along_widest(points):
    """Compute coordinates along the direction in which points spread most."""
    offset = points - np.median(points, axis=0)
    _, _, axes = np.linalg.svd(offset, full_matrices=False)
    return offset @ axes[0]
