"""External preprocessing of a capture: tracks, masks, depth and flow of other tools."""

import dataclasses
import pathlib
from typing import NamedTuple

import numpy as np

from nerfies_jax.runtime import earlier_names

__getattr__ = earlier_names.attributes(__name__)


@dataclasses.dataclass(frozen=True)
class ExternalFiles:
    """Preprocessing files of other tools (docs/formats.md), as absolute paths."""

    tracks: pathlib.Path | str | None = None
    """Tracks of TAPIR, BootsTAPIR, CoTracker or LocoTrack: npz, or a folder of npy."""
    masks: pathlib.Path | str | None = None
    """Folder of PNGs, white where something moves."""
    depths: pathlib.Path | str | None = None
    """Depths or inverse depths of any scale: npz, npy, or a folder of EXR, PNG or
    npy."""
    flow: pathlib.Path | str | None = None
    """Optical flow: npz of forward and backward flow, or a folder with .flo of each."""
    times: pathlib.Path | str | None = None
    """Frame times in seconds or on any clock: text with a name and a time in each line,
    or JSON."""
    depth_model: pathlib.Path | str | None = None
    """Network for depth from one image, as an ONNX file (docs/networks.md)."""
    segmentation_model: pathlib.Path | str | None = None
    """Network that segments what may move, as an ONNX file (docs/networks.md)."""

    def __post_init__(self):
        for name, model in (("depths", "depth_model"), ("masks", "segmentation_model")):
            if None not in (getattr(self, name), getattr(self, model)):
                raise ValueError(
                    f"{name}={getattr(self, name)} and {model}={getattr(self, model)}: "
                    "both provide the same; leave one out"
                )
        for name, path in vars(self).items():
            if path is not None:
                object.__setattr__(self, name, pathlib.Path(path).absolute())


class ExternalResults(NamedTuple):
    """External preprocessing results by frame, in pixels of `size`, None where absent.

    Pixels are those of the images of the capture, with their lens distortion. Frames
    that the tool did not process have no visible tracks, no moving pixels, and NaN.
    """

    size: tuple[int, int]  # width and height
    track_pixel: np.ndarray | None = None  # [frames, tracks, 2]; centers at +0.5
    track_seen: np.ndarray | None = None  # [frames, tracks] bool
    moving: np.ndarray | None = None  # [frames, height, width] bool
    # [frames, height, width] depth or inverse depth of any scale and offset, NaN where
    # unknown
    depth: np.ndarray | None = None
    inverse: bool | None = None  # True for inverse depth, None if it is not known
    # [frames, height, width, 2] from each training frame to the next and the previous
    # one in time
    forward: np.ndarray | None = None
    backward: np.ndarray | None = None


def take(external: ExternalResults, rows: np.ndarray) -> ExternalResults:
    """Select frames. Flow is dropped, since its target frames may not be selected.

    Args:
      external: External preprocessing results.
      rows: Indices of the frames, in the order of the result.

    Returns:
      The results of these frames.
    """
    arrays = external._asdict()
    for name in ("size", "inverse", "forward", "backward"):
        del arrays[name]
    selection = {
        name: None if array is None else array[rows] for name, array in arrays.items()
    }
    return ExternalResults(external.size, inverse=external.inverse, **selection)
