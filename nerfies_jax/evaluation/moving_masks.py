"""Masks of moving pixels in held-out frames, for captures without masks."""

import dataclasses
import math
import pathlib

import numpy as np

from nerfies_jax.capture import capture as captures
from nerfies_jax.capture.capture import Capture
from nerfies_jax.preprocessing import frame_masks, motion, record, view_set

MAX_PIXELS = 4_000_000  # of all frames together, which take 45 s on one core


def with_masks(capture: Capture, folder: pathlib.Path) -> tuple[Capture, str]:
    """Add masks of moving pixels to a capture that has none.

    They are computed by preprocessing all frames together, including held-out ones, so
    they are for evaluation only, never for training. Only the masks of held-out rows
    may be read.

    Args:
      capture: The capture, possibly with lens distortion.
      folder: Cache folder of preprocessing.

    Returns:
      The capture and a note. The capture has no masks if tracking fails, or if nothing
      moves: what is left then are pixels that could not be tracked.
    """
    if capture.moving is not None or not len(capture.heldout):
        return capture, ""
    moving, unusable = np.zeros(capture.images.shape[:3], bool), ""
    for rows in _candidate_rows(capture):
        factor = math.ceil(math.sqrt(len(rows) * math.prod(capture.size) / MAX_PIXELS))
        video = dataclasses.replace(capture, train=rows, heldout=np.zeros(0, int))
        video = captures.downscale(captures.select(video, rows), factor)
        evidence = record.cached(video, folder, masks_only=True)
        if not evidence.unusable:
            break
        unusable = unusable or evidence.unusable
    else:
        return capture, (
            f"Dynamic regions are not evaluated separately, because the capture has no "
            f"masks and tracking failed: {unusable}."
        )
    views = view_set.in_time_order(record.downscale(video, evidence.factor))
    finding = motion.motion(views, evidence)
    if finding.wanted is False:
        return capture, (
            "Dynamic regions are not evaluated separately, because nothing moves: "
            f"{finding.evidence}."
        )
    for row, mask in zip(rows, frame_masks.of_frames(evidence, video), strict=True):
        moving[row] = frame_masks.enlarged(mask, factor, capture.size)
    share = moving[capture.heldout].mean()
    note = (
        f"Dynamic regions ({share:.1%} of the held-out pixels) are detected from point "
        "tracks, because the capture has no masks."
    )
    if evidence.left_out:
        note += f" {record.left_out_note(evidence)}"
    return dataclasses.replace(capture, moving=moving), note


def _candidate_rows(capture):
    """Return frames to track points in: all, then those of the held-out cameras.

    The second choice is for camera rigs, between whose images the view jumps. With
    held-out frames of the built-in scene from a camera next to the training camera, the
    overlap (IoU) with the true masks is 0.72 for the first choice (0.79 in training
    frames), and 0.40 for the second, whose frames are four times as far apart.
    """
    used = np.sort(np.concatenate([capture.train, capture.heldout]))
    heldout_cameras = np.unique(capture.camera_ids[capture.heldout])
    same_cameras = used[np.isin(capture.camera_ids[used], heldout_cameras)]
    return (used,) if len(same_cameras) == len(used) else (used, same_cameras)
