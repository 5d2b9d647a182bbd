"""Arrays in files of other tools, and the frames of a capture that they belong to."""

import pathlib

import numpy as np

from nerfies_jax.capture import npz_files
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
    learned = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    in_time = np.argsort(capture.times, kind="stable")
    for rows in (learned, in_time):
        if count == len(rows):
            return rows
    raise CaptureError(
        f"{path}: {what} of {count} frames, but the capture has {len(in_time)} frames "
        f"({len(learned)} training frames); provide one for each, in temporal order"
    )


def read(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Read the arrays of an npz.

    Args:
      path: The file.

    Returns:
      Arrays of numbers or booleans by name.

    Raises:
      CaptureError: If it is damaged, or holds something else.
    """
    try:
        arrays = npz_files.read_arrays(path)
    except CaptureError:
        raise
    except ValueError as error:
        raise CaptureError(
            f"{path}: not a readable npz ({error}); save it with numpy.savez"
        ) from None
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub" or array.size > MOST_NUMBERS:
            raise CaptureError(
                f"{path}: {name} is {array.dtype} of shape {array.shape}; expected at "
                f"most {MOST_NUMBERS} numbers"
            )
    return arrays
