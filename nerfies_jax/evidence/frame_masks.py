"""Masks of what moves for a capture that came without, on the frames learned from."""

import dataclasses
import pathlib

import numpy as np

from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evidence import record


def with_masks(capture: Capture, folder: pathlib.Path = CACHE / "evidence") -> Capture:
    """The capture with the evidence's masks of its frames learned from; held-out ones,
    which are not looked at, have none.

    As it was, with a note, where the film cannot be followed.
    """
    evidence = record.cached(capture, folder)
    if evidence.unusable:
        note = f"no masks of what moves could be made: {evidence.unusable}"
        return dataclasses.replace(capture, notes=(*capture.notes, note))
    moving = np.zeros(capture.images.shape[:3], bool)
    for row, mask in zip(evidence.row, evidence.moving, strict=True):
        moving[row] = enlarged(mask, evidence.factor, capture.size)
    note = f"masks of what moves found in the pictures, {evidence.moving.mean():.1%}"
    return dataclasses.replace(capture, moving=moving, notes=(*capture.notes, note))


def enlarged(mask: np.ndarray, factor: int, size: tuple[int, int]) -> np.ndarray:
    """Each pixel of [lines, columns] `factor` times as wide and high, up to `size`.

    What was trimmed is like its edge.
    """
    mask = mask.repeat(factor, 0).repeat(factor, 1)
    width, height = size
    short = (0, height - mask.shape[0]), (0, width - mask.shape[1])
    return np.pad(mask, short, mode="edge")
