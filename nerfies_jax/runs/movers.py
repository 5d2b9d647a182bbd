"""Masks of moving objects in images whose cameras may not be known yet."""

import dataclasses

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.preprocessing import frame_masks, record

LEAST_SHARE = 0.005  # of the pixels: cameras hardly notice less


def masks_of(pictures: Capture) -> np.ndarray | None:
    """Segment moving objects from tracks that the static points do not explain.

    Args:
      pictures: The images as a capture, whose cameras may be wrong.

    Returns:
      Booleans [frames, height, width], or None if nothing moves.
    """
    rows = np.arange(len(pictures.ids))
    every = dataclasses.replace(pictures, train=rows, heldout=rows[:0])
    evidence = record.gather(every)
    if evidence.unusable or evidence.moving.mean() < LEAST_SHARE:
        return None
    masks = np.zeros((len(rows), *pictures.images.shape[1:3]), bool)
    for row, mask in zip(evidence.row, evidence.moving, strict=True):
        masks[row] = frame_masks.enlarged(mask, evidence.factor, pictures.size)
    return masks
