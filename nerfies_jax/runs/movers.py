"""What moves by itself in pictures whose cameras were found, or not yet."""

import dataclasses

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evidence import frame_masks, record

LEAST_SHARE = 0.005  # of the pixels: cameras hardly notice less


def masks_of(pictures: Capture) -> np.ndarray | None:
    """[frames, height, width] bool, True where something moves; None where nothing.

    Frames are those of the capture, whose cameras may be off: tracks that its points
    at rest do not explain are taken to move.
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
