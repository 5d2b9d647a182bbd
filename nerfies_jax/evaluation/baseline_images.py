"""Baseline images for held-out frames: neighboring frames, and static renders.

One baseline is the mean of the two neighboring training frames, the other the mean of
renders of the model over time. A model that scores below the first is worse than two
superimposed frames. One that scores below the second is better without its motion.
"""

from typing import NamedTuple

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.frames import spread, view_of
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.training.model import TrainState, in_default_precision

NEIGHBORS = 2


class Averages(NamedTuple):
    """Baseline images of held-out frames, in NumPy."""

    places: np.ndarray  # [places] indices into the scored frames
    color: np.ndarray  # [places, height, width, 3] float32 in [0, 1]
    known: np.ndarray | None  # [places, height, width] bool, None if all pixels are


class Baselines(NamedTuple):
    """Both baselines of one run, None if they do not exist."""

    neighbors: Averages | None
    static: Averages | None


def neighbor_rows(capture: Capture, row: int | np.integer) -> np.ndarray:
    """Find the two training frames nearest in time to a frame, nearest first.

    Only frames of the same camera are used if it has at least two training frames. Of
    frames at the same distance, the first in the capture is used.

    Args:
      capture: The capture.
      row: Index of the frame.

    Returns:
      Indices of the frames.
    """
    rows = capture.train
    same = rows[capture.camera_ids[rows] == capture.camera_ids[row]]
    rows = np.sort(same if len(same) >= NEIGHBORS else rows)
    difference = np.abs(
        capture.times[rows].astype(np.float64) - float(capture.times[row])
    )
    # Rounded, because timestamps are float32.
    return rows[np.argsort(np.round(difference, 6), kind="stable")[:NEIGHBORS]]


def neighbor_means(capture: Capture, rows: np.ndarray) -> Averages | None:
    """Compute the mean of the two neighboring training frames of each row.

    Args:
      capture: The capture.
      rows: Indices of the frames.

    Returns:
      The means over the neighbors in which a pixel is valid. Pixels that are valid in
      none are unknown. None if there are no two training frames at different times.
    """
    if len(capture.train) < NEIGHBORS or not np.ptp(capture.times[capture.train]):
        return None
    colors, validity = [], []
    for row in rows:
        neighbors = neighbor_rows(capture, row)
        images = capture.images[neighbors].astype(np.float32) / 255
        valid = np.ones(images.shape[:3], bool)
        if capture.valid is not None:
            valid = capture.valid[neighbors]
        count = valid.sum(axis=0)
        total = np.where(valid[..., None], images, 0).sum(axis=0)
        colors.append(total / np.maximum(count, 1)[..., None])
        validity.append(count > 0)
    return Averages(
        np.arange(len(rows)),
        np.stack(colors).astype(np.float32),
        None if capture.valid is None else np.stack(validity),
    )


def time_averages(
    draw: Draw,
    state: TrainState,
    capture: Capture,
    rows: np.ndarray,
    frames: int,
    timestamps: int,
) -> Averages:
    """Average renders over time, from the cameras of some frames.

    Camera and appearance of each frame stay the same. Colors are clipped and averaged
    in sRGB.

    Args:
      draw: Renderer.
      state: Trained state.
      capture: The capture.
      rows: Indices of the frames.
      frames: Largest number of frames, evenly spaced over the rows.
      timestamps: Largest number of times, evenly spaced over those of training frames.

    Returns:
      The means.

    Raises:
      ValueError: If `frames` or `timestamps` is below 1.
    """
    if frames < 1 or timestamps < 1:
        raise ValueError(
            f"frames={frames} and timestamps={timestamps} must be at least 1 for an "
            "average over time"
        )
    places = spread(np.arange(len(rows)), frames)
    times = spread(np.unique(capture.times[capture.train]), timestamps)
    views = [view_of(capture, row) for row in rows[places]]
    width, height = capture.size
    total = np.zeros((len(views), height, width, 3))
    # Time is the outer loop, because renderers cache the deformed scene.
    for time in map(in_default_precision, times):
        for place, view in enumerate(views):
            color = draw(state, view._replace(time=time)).color
            total[place] += np.clip(color, 0, 1)
    return Averages(places, (total / len(times)).astype(np.float32), None)
