"""Masks of moving pixels in held-out frames, for captures without masks."""

import dataclasses
import math
import pathlib

import numpy as np

from nerfies_jax.capture import capture as captures
from nerfies_jax.capture import pinholes, resampling
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.preprocessing import frame_masks, record

MOST_PIXELS = 4_000_000  # of all frames looked at: 45 s on one core


def with_masks(filmed: Capture, folder: pathlib.Path) -> tuple[Capture, str]:
    """Add masks of moving pixels to a capture that has none.

    They are computed by preprocessing all frames together, including held-out ones, so
    they are for evaluation only, never for training. Only the masks of held-out rows
    may be read.

    Args:
      filmed: The capture.
      folder: Cache folder of preprocessing.

    Returns:
      The capture and a note. The capture has no masks if tracking fails.
    """
    if filmed.moving is not None or not len(filmed.heldout):
        return filmed, ""
    moving, unusable = np.zeros(filmed.images.shape[:3], bool), ""
    for rows in _films(filmed):
        factor = math.ceil(math.sqrt(len(rows) * math.prod(filmed.size) / MOST_PIXELS))
        film = dataclasses.replace(filmed, train=rows, heldout=np.zeros(0, int))
        film = captures.downscale(captures.select(film, rows), factor)
        evidence = record.cached(film, folder)
        if not evidence.unusable:
            break
        unusable = unusable or evidence.unusable
    else:
        return filmed, f"What moves is not scored apart: {unusable}."
    for row, mask in zip(rows[evidence.row], evidence.moving, strict=True):
        times = factor * evidence.factor
        moving[row] = frame_masks.enlarged(mask, times, filmed.size)
    moving = _bent(moving, filmed)
    share = moving[filmed.heldout].mean()
    note = (
        f"What moves is where tracks do ({share:.1%} of the held-out pixels): the "
        "capture has no masks of its own."
    )
    if evidence.left_out:
        note += f" {record.left_out_note(evidence)}"
    return dataclasses.replace(filmed, moving=moving), note


def _films(capture):
    """Rows to follow points through: all, then those of the cameras that are scored.

    The second where pictures jump between the cameras of a rig. Held-out frames of the
    built-in scene, filmed by a camera beside that learned from: the masks overlap the
    true ones to 0.72 in the first way (0.79 where frames are learned from), and to 0.40
    in the second, whose frames are four times as far apart.
    """
    used = np.sort(np.concatenate([capture.train, capture.heldout]))
    scored = np.unique(capture.camera_ids[capture.heldout])
    own = used[np.isin(capture.camera_ids[used], scored)]
    return (used,) if len(own) == len(used) else (used, own)


def _bent(moving, filmed):
    """Distort masks of pinhole images to the pixels of the captured images."""
    if not pinholes.has_lens(filmed.cameras):
        return moving
    maps = pinholes.Maps(pinholes.pinhole_places, filmed.size)
    for row in filmed.heldout:
        place, inside = maps.of(cameras.take(filmed.cameras, row))
        moving[row] = inside & resampling.nearest(moving[row], place)
    return moving
