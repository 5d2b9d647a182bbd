"""Checks of masks and times of a capture's frames."""

import numpy as np

from nerfies_jax.capture import name_times
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.gate_finding import Finding

LEAST_OBSERVED, MOST_MOVING = 0.02, 0.9
# Largest value of a dark image, of 255. 16-bit images with values of 12 or fewer bits
# are darker.
DARK = 64
# A gap between times is a problem if it exceeds this multiple of the median gap and
# this share of the duration.
GAP, GAP_SHARE = 10.0, 0.25
# Largest share of consecutive frames, by numbers in their names, with falling times.
OUT_OF_ORDER = 0.05
_MASKS = (
    "check the masks (white is observed; 0 and 1 are read as black and white) and "
    "the alpha channel of the images"
)


def findings(capture: Capture) -> list[Finding]:
    """Check brightness, shares of observed and moving pixels, and times.

    Args:
      capture: The capture.

    Returns:
      The findings.
    """
    return [
        _brightness(capture),
        *_find_unobserved(capture),
        *_moving(capture),
        *_times(capture),
    ]


def _brightness(capture):
    """Check if images use only the lowest of their values."""
    least, most = int(capture.images.min()), int(capture.images.max())
    value = f"{least} to {most}"
    problem = ""
    if most < DARK:
        problem = (
            f"no pixel of any image is brighter than {most} of 255: 16-bit files may "
            "hold values of 8, 10 or 12 bits; scale them to their full range"
        )
    return Finding("brightness", value, problem)


def _find_unobserved(capture):
    if capture.valid is None:
        return [Finding("observed pixels", "all")]
    share = capture.valid.mean((1, 2))
    train_share = share[capture.train]
    value = f"{share.mean():.1%}"
    problem = ""
    if train_share.mean() < LEAST_OBSERVED:
        problem = f"{train_share.mean():.2%} of the pixels are observed; {_MASKS}"
    elif (empty := capture.train[train_share == 0]).size:
        problem = f"{_frame_list(capture, empty)} without an observed pixel; {_MASKS}"
    return [Finding("observed pixels", value, problem)]


def _moving(capture):
    external = None if capture.external is None else capture.external.moving
    moving = capture.moving if external is None else external
    if moving is None:
        return []
    share = moving.mean((1, 2))
    train_share = share[capture.train]
    value = f"{share.mean():.1%}"
    problem = ""
    if train_share.mean() > MOST_MOVING:
        problem = (
            f"{train_share.mean():.0%} of the pixels are marked as moving: the masks "
            "may be inverted"
        )
    elif (full := capture.train[train_share == 1]).size:
        frames = _frame_list(capture, full)
        problem = f"{frames} marked as moving everywhere; check their masks"
    return [Finding("moving pixels", value, problem)]


def _frame_list(capture, rows):
    names = ", ".join(capture.ids[row] for row in rows[:5])
    return f"{len(rows)} frames ({names}{', ...' if len(rows) > 5 else ''})"


def _times(capture):
    rows = capture.train
    times = np.float64(capture.times[rows])
    distinct = np.unique(times)
    if len(distinct) < 2:
        return [Finding("times", "all frames at one time")]
    gaps = np.diff(distinct)
    largest, median = float(gaps.max()), float(np.median(gaps))
    pairs = np.stack([times, capture.camera_ids[rows]], axis=1)
    duplicates = len(rows) - len(np.unique(pairs, axis=0))
    value = (
        f"{distinct[0]:.4g} to {distinct[-1]:.4g}, {len(distinct)} different, largest "
        f"gap {largest:.3g} (median {median:.3g}), {duplicates} duplicates"
    )
    problem = _time_problem(capture, largest, median, duplicates)
    return [Finding("times", value, problem)]


def _time_problem(capture, largest, median, duplicates):
    if duplicates:
        return (
            f"{duplicates} frames have the time of another frame of their camera: "
            "several cameras may be taken for one, or times are rounded; provide the "
            "times"
        )
    if largest > GAP * median and largest > GAP_SHARE:
        return (
            f"there are no frames during {largest:.0%} of the time, and frames are "
            f"usually {median:.2g} apart: times may mix clocks or units; provide the "
            "times, or split the capture there"
        )
    out_of_order = _share_out_of_order(capture)
    if out_of_order > OUT_OF_ORDER:
        return (
            f"times fall in {out_of_order:.0%} of the steps from one number in the "
            "names to the next: times or names may belong to other frames; provide the "
            "times"
        )
    return ""


def _share_out_of_order(capture):
    """Share of consecutive frames, by numbers in their names, with falling times."""
    falls = steps = 0
    for number in np.unique(capture.camera_ids[capture.train]):
        rows = capture.train[capture.camera_ids[capture.train] == number]
        clock = name_times.clock([capture.ids[row] for row in rows])
        if clock.notes or len(rows) < 3:  # the names have no common number
            continue
        order = np.argsort(clock.times, kind="stable")
        change = np.diff(np.float64(capture.times[rows][order]))
        falls += int((change < -1e-6).sum())
        steps += len(change)
    return falls / steps if steps else 0.0
