"""Masks of moving objects in images whose cameras may be inaccurate."""

import dataclasses

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.preprocessing import frame_masks, record

MIN_MOVING_SHARE = 0.005  # of the pixels. Fewer hardly affect the cameras.


def masks_of(capture: Capture) -> np.ndarray | None:
    """Segment moving objects, from tracks that no static point explains.

    Args:
      capture: The images. The cameras may be inaccurate.

    Returns:
      Booleans [frames, height, width], or None if nothing moves.
    """
    rows = np.arange(len(capture.ids))
    all_frames = dataclasses.replace(capture, train=rows, heldout=rows[:0])
    evidence = record.gather(all_frames, rough_cameras=True, masks_only=True)
    if evidence.unusable or evidence.moving.mean() < MIN_MOVING_SHARE:
        return None
    return frame_masks.of_frames(evidence, capture)
