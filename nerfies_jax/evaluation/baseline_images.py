"""Baselines of held-out frames: neighboring frames, and the scene without its motion.

One baseline is the mean of the two neighboring frames, the other the mean of the
scene's own renders over time. A scene below the first is worse than two superimposed
frames, and one below the second is better without its motion.
"""

from typing import NamedTuple

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.frames import spread, view_of
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.training.model import TrainState, in_default_precision

NEIGHBORS = 2


class Averages(NamedTuple):
    """Baseline images of held-out frames, in NumPy, with one row for each."""

    places: np.ndarray  # which of the scored frames
    color: np.ndarray  # [places, height, width, 3] float32 in [0, 1]
    known: np.ndarray | None  # [places, height, width] bool; None where all of it is


class Baselines(NamedTuple):
    """Both baselines of one run, None where they do not exist."""

    neighbors: Averages | None
    static: Averages | None


def neighbor_rows(capture: Capture, row: int | np.integer) -> np.ndarray:
    """Find the two training frames nearest in time to a frame, nearest first.

    They are of the same camera if that has at least two training frames, else of any
    camera. Ties go to the first in the capture.

    Args:
      capture: The capture.
      row: Index of the frame.

    Returns:
      Indices of the frames.
    """
    rows = capture.train
    same = rows[capture.camera_ids[rows] == capture.camera_ids[row]]
    rows = np.sort(same if len(same) >= NEIGHBORS else rows)
    apart = np.abs(capture.times[rows].astype(np.float64) - float(capture.times[row]))
    # Times are float32: a tie is within 1e-6.
    return rows[np.argsort(np.round(apart, 6), kind="stable")[:NEIGHBORS]]


def neighbor_means(capture: Capture, rows: np.ndarray) -> Averages | None:
    """Compute the mean of the neighboring frames of each row, as captured.

    Args:
      capture: The capture.
      rows: Indices of the frames.

    Returns:
      The means over those neighbors that observed a pixel, unknown where none did. None
      if there are no two training frames at different times.
    """
    if len(capture.train) < NEIGHBORS or not np.ptp(capture.times[capture.train]):
        return None
    colors, known = [], []
    for row in rows:
        chosen = neighbor_rows(capture, row)
        pictures = capture.images[chosen].astype(np.float32) / 255
        filmed = np.ones(pictures.shape[:3], bool)
        if capture.valid is not None:
            filmed = capture.valid[chosen]
        count = filmed.sum(axis=0)
        total = np.where(filmed[..., None], pictures, 0).sum(axis=0)
        colors.append(total / np.maximum(count, 1)[..., None])
        known.append(count > 0)
    return Averages(
        np.arange(len(rows)),
        np.stack(colors).astype(np.float32),
        None if capture.valid is None else np.stack(known),
    )


def time_averages(
    draw: Draw,
    state: TrainState,
    capture: Capture,
    rows: np.ndarray,
    frames: int,
    moments: int,
) -> Averages:
    """Average renders over time, from the cameras of some frames.

    Cameras and appearance stay the same. Colors are clipped, then averaged as stored
    (sRGB).

    Args:
      draw: Renderer.
      state: Trained state.
      capture: The capture.
      rows: Indices of the frames.
      frames: Largest number of frames, evenly spread over the rows.
      moments: Largest number of times, evenly spread over those of training frames.

    Returns:
      The means.

    Raises:
      ValueError: If `frames` or `moments` is below 1.
    """
    if frames < 1 or moments < 1:
        raise ValueError(
            f"an average over time needs at least one frame and one time, got "
            f"frames={frames} and moments={moments}"
        )
    places = spread(np.arange(len(rows)), frames)
    times = spread(np.unique(capture.times[capture.train]), moments)
    views = [view_of(capture, row) for row in rows[places]]
    width, height = capture.size
    total = np.zeros((len(views), height, width, 3))
    for time in times:  # outside: what is deformed for an instant serves all its views
        instant = in_default_precision(time)
        for place, view in enumerate(views):
            color = draw(state, view._replace(time=instant)).color
            total[place] += np.clip(color, 0, 1)
    return Averages(places, (total / len(times)).astype(np.float32), None)
