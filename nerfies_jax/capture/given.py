"""External preprocessing of a capture (tracks, masks, depth, flow), used as given."""

import dataclasses
import pathlib
from typing import NamedTuple

import numpy as np


@dataclasses.dataclass(frozen=True)
class GivenFiles:
    """Files of other tools (docs/formats.md)."""

    tracks: pathlib.Path | str | None = None  # a path, once it is made
    """Tracks of TAPIR or CoTracker, npz, whose paths in space are taken."""
    masks: pathlib.Path | str | None = None
    """Folder of PNGs, white where something moves."""
    depths: pathlib.Path | str | None = None
    """Depths or inverse depths of any scale: npz, npy, folder of EXR, PNG or npy."""
    flow: pathlib.Path | str | None = None
    """Optical flow: npz of forward and backward, or a folder with .flo of each."""
    times: pathlib.Path | str | None = None
    """Frame times in seconds or on any clock: text with a name and a time in each line,
    or JSON."""

    def __post_init__(self):
        for name, path in vars(self).items():
            if path is not None:
                object.__setattr__(self, name, pathlib.Path(path).absolute())


class Given(NamedTuple):
    """External preprocessing results by frame, in pixels of `size`, None where absent.

    Frames that the tool did not process have no visible tracks, no moving pixels, and
    NaN.
    """

    size: tuple[int, int]  # width and height
    track_pixel: np.ndarray | None = None  # [frames, tracks, 2]; centers at +0.5
    track_seen: np.ndarray | None = None  # [frames, tracks] bool
    track_place: np.ndarray | None = None  # [frames, tracks, 3] scene units
    moving: np.ndarray | None = None  # [frames, height, width] bool
    # [frames, height, width], of any scale and offset, or inverse; NaN unknown
    depth: np.ndarray | None = None
    # [frames, height, width, 2] from each frame to learn from to the next in time, and
    # back to the one before
    forward: np.ndarray | None = None
    backward: np.ndarray | None = None


def take(given: Given, rows: np.ndarray) -> Given:
    """Select frames. Flow is dropped, since its target frames change.

    Args:
      given: External preprocessing results.
      rows: Indices of the frames, in the order of the result.

    Returns:
      The results of these frames.
    """
    parts = given._asdict()
    del parts["size"], parts["forward"], parts["backward"]
    kept = {
        name: None if array is None else array[rows] for name, array in parts.items()
    }
    return Given(given.size, **kept)
