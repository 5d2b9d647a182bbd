"""Masks of moving pixels in training frames, for a capture without masks."""

import dataclasses
import pathlib
from typing import Any

import numpy as np

from nerfies_jax.capture import pinholes
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.preprocessing import record


def with_masks(capture: Capture, folder: pathlib.Path = CACHE / "evidence") -> Capture:
    """Compute masks of the training frames by preprocessing.

    Held-out frames are not used and have no masks.

    Args:
      capture: The capture.
      folder: Cache folder of preprocessing.

    Returns:
      The capture with masks, or the same with a note if tracking fails.
    """
    evidence = record.cached(capture, folder)
    if evidence.unusable:
        note = f"masks of moving objects could not be computed: {evidence.unusable}"
        return dataclasses.replace(capture, notes=(*capture.notes, note))
    moving = of_frames(evidence, capture)
    note = (
        "masks of moving objects were computed from the images: "
        f"{evidence.moving.mean():.1%} of the pixels"
    )
    return dataclasses.replace(capture, moving=moving, notes=(*capture.notes, note))


def of_frames(evidence: Any, capture: Capture) -> np.ndarray:
    """Return the masks of preprocessing in the pixels of the captured images.

    Args:
      evidence: Preprocessing of the capture (`record.Evidence`), undistorted.
      capture: The capture.

    Returns:
      Booleans [frames, height, width], False in frames without masks.
    """
    moving = np.zeros(capture.images.shape[:3], bool)
    canvas = pinholes.canvas(capture)
    for row, mask in zip(evidence.row, evidence.moving, strict=True):
        full = enlarged(mask, evidence.factor, canvas.size)
        camera = cameras.take(capture.cameras, row)
        moving[row] = pinholes.as_observed(full, camera, canvas, capture.size)
    return moving


def enlarged(mask: np.ndarray, factor: int, size: tuple[int, int]) -> np.ndarray:
    """Enlarge a mask by an integer factor, and extend it at the right and bottom.

    Args:
      mask: The mask, [lines, columns].
      factor: Integer factor.
      size: Width and height of the result in pixels.

    Returns:
      The mask, [height, width].
    """
    mask = mask.repeat(factor, 0).repeat(factor, 1)
    width, height = size
    short = (0, height - mask.shape[0]), (0, width - mask.shape[1])
    return np.pad(mask, short, mode="edge")
