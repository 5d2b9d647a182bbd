"""Checks of masks and times of a capture's frames."""

import numpy as np

from nerfies_jax.capture import name_times
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.gate_finding import Finding

LEAST_OBSERVED, MOST_MOVING = 0.02, 0.9
DARK = 64  # as images of 12 bits, and fewer, in 16 bits are
# A gap between times is named if it is so many times the usual one, and such a share
# of the whole.
GAP, GAP_SHARE = 10.0, 0.25
OUT_OF_ORDER = 0.05  # of the steps between frames in the order of their numbers
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
        *_observed(capture),
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


def _observed(capture):
    if capture.valid is None:
        return [Finding("observed pixels", "all")]
    share = capture.valid.mean((1, 2))
    learned = share[capture.train]
    value = f"{share.mean():.1%}"
    problem = ""
    if learned.mean() < LEAST_OBSERVED:
        problem = f"{learned.mean():.2%} of the pixels are observed; {_MASKS}"
    elif (empty := capture.train[learned == 0]).size:
        problem = f"{_listed(capture, empty)} without an observed pixel; {_MASKS}"
    return [Finding("observed pixels", value, problem)]


def _moving(capture):
    given = None if capture.given is None else capture.given.moving
    moving = capture.moving if given is None else given
    if moving is None:
        return []
    share = moving.mean((1, 2))
    learned = share[capture.train]
    value = f"{share.mean():.1%}"
    problem = ""
    if learned.mean() > MOST_MOVING:
        problem = (
            f"{learned.mean():.0%} of the pixels are marked as moving: the masks may "
            "be inverted"
        )
    elif (full := capture.train[learned == 1]).size:
        problem = (
            f"{_listed(capture, full)} marked as moving everywhere; check their masks"
        )
    return [Finding("moving pixels", value, problem)]


def _listed(capture, rows):
    names = ", ".join(capture.ids[row] for row in rows[:5])
    return f"{len(rows)} frames ({names}{', ...' if len(rows) > 5 else ''})"


def _times(capture):
    rows = capture.train
    times = np.float64(capture.times[rows])
    moments = np.unique(times)
    if len(moments) < 2:
        return [Finding("times", "all frames at one time")]
    gaps = np.diff(moments)
    widest = int(gaps.argmax())
    largest, usual = float(gaps[widest]), float(np.median(gaps))
    pairs = np.stack([times, capture.camera_ids[rows]], axis=1)
    doubles = len(rows) - len(np.unique(pairs, axis=0))
    value = (
        f"{moments[0]:.4g} to {moments[-1]:.4g}, {len(moments)} different, largest gap "
        f"{largest:.3g} (usually {usual:.3g}), {doubles} duplicates"
    )
    return [Finding("times", value, _time_problem(capture, largest, usual, doubles))]


def _time_problem(capture, largest, usual, doubles):
    if doubles:
        return (
            f"{doubles} frames have the time of another frame of their camera: several "
            "cameras may be taken for one, or times are rounded; state the times"
        )
    if largest > GAP * usual and largest > GAP_SHARE:
        return (
            f"nothing was filmed during {largest:.0%} of the time, and frames are "
            f"usually {usual:.2g} apart: times may mix clocks or units; state the "
            "times, or cut the capture there"
        )
    disordered = _disorder(capture)
    if disordered > OUT_OF_ORDER:
        return (
            f"times fall in {disordered:.0%} of the steps from one number in the names "
            "to the next: times or names may be of other frames; state the times"
        )
    return ""


def _disorder(capture):
    """Share of steps between numbers in the names at which times fall."""
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
