"""Times, numbers and held-out frames of a capture, shared by all readers."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerfies_jax.capture.capture import CaptureError

HELD_OUT = 8  # by default every 8th frame is held out, as in LLFF and Mip-NeRF 360


def hold_out_in_time(
    times: ArrayLike, camera_ids: ArrayLike, every: int, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Apply `hold_out_every` in order of time, one camera after the other.

    Args:
      times: Frame times, in any order.
      camera_ids: Physical camera of each frame.
      every: Interval of held-out frames.
      where: Name of the capture in error messages.

    Returns:
      Training rows and held-out rows, each in ascending order.
    """
    order = np.lexsort((np.asarray(times), np.asarray(camera_ids)))
    train, heldout = hold_out_every(len(order), every, where)
    return np.sort(order[train]), np.sort(order[heldout])


def hold_out_every(count: int, every: int, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Hold out the middle frame of each group of `every` frames.

    Held-out frames thus have training frames on both sides. One frame is held out if
    there are fewer than `every`, and none if there are fewer than three.

    Args:
      count: Number of frames.
      every: Interval of held-out frames, at least 2.
      where: Name of the capture in error messages.

    Returns:
      Training rows and held-out rows.

    Raises:
      CaptureError: If `every` is below 2.
    """
    if every < 2:
        raise CaptureError(
            f"{where}: heldout={every} leaves no training frames; expected at least 2"
        )
    if count >= 3:
        every = min(every, count)
    rows = np.arange(count)
    is_heldout = rows % every == every // 2
    return rows[~is_heldout], rows[is_heldout]


def held_out_note(heldout: np.ndarray | list[Any], every: int) -> str:
    """Describe the frames that `hold_out_every` held out.

    Args:
      heldout: Rows of the held-out frames.
      every: Distance between them in frames.

    Returns:
      A clause without a final period.
    """
    if not len(heldout):
        return "no frames are held out: there are too few"
    if len(heldout) == 1:
        return "one frame is held out"
    ending = {1: "st", 2: "nd", 3: "rd"}.get(every % 10, "th")
    ending = "th" if every % 100 in (11, 12, 13) else ending
    return f"every {every}{ending} frame is held out"


def dense(values: ArrayLike) -> np.ndarray:
    """Number distinct values in ascending order.

    Args:
      values: Values, [frames].

    Returns:
      int32 numbers 0..n-1, equal for equal values.
    """
    return np.unique(np.asarray(values), return_inverse=True)[1].astype(np.int32)


def spread(values: ArrayLike) -> np.ndarray:
    """Normalize times to [0, 1].

    Args:
      values: Times on any clock, [frames].

    Returns:
      float32 times, zeros if all are equal.
    """
    values = np.asarray(values, np.float64)
    first, last = values.min(), values.max()
    if last == first:
        return np.zeros(len(values), np.float32)
    return ((values - first) / (last - first)).astype(np.float32)
