"""Assignment of arrays in files of other tools to the frames of a capture."""

import pathlib

import numpy as np

from nerfies_jax.capture.capture import Capture, CaptureError

MOST_NUMBERS = 2_000_000_000  # of one file


def frames_of(
    count: int, capture: Capture, path: pathlib.Path, what: str
) -> np.ndarray:
    """Find the frames of a capture that a number of frames refers to.

    Args:
      count: Number of frames in a file.
      capture: The capture.
      path: The file, for errors.
      what: Name of its content, for errors.

    Returns:
      Indices of the training frames or of all frames, in temporal order, [count].

    Raises:
      CaptureError: If the number is that of neither.
    """
    train_rows = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    all_rows = np.argsort(capture.times, kind="stable")
    for rows in (train_rows, all_rows):
        if count == len(rows):
            return rows
    raise CaptureError(
        f"{path}: {what} of {count} frames, but the capture has {len(all_rows)} frames "
        f"({len(train_rows)} training frames); provide one for each, in temporal order"
    )
