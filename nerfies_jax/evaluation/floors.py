"""What held-out frames are worth without a scene, and without its motion.

Two pictures that cost nothing to make: the mean of the neighboring frames, and the
mean of a scene's own renders over time. A scene below the first shows less than two
frames laid over each other do, and one below the second is better with its motion
left out.
"""

from typing import NamedTuple

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.frames import spread, view_of
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.training.model import TrainState, in_default_precision

NEIGHBORS = 2


class Averages(NamedTuple):
    """Held-out frames made of other pictures; NumPy, one row for each."""

    places: np.ndarray  # which of the scored frames
    color: np.ndarray  # [places, height, width, 3] float32 in [0, 1]
    known: np.ndarray | None  # [places, height, width] bool; None where all of it is


class Floors(NamedTuple):
    """Both floors of one run; None where there is nothing to take the mean of."""

    neighbors: Averages | None
    still: Averages | None


def neighbor_rows(capture: Capture, row: int | np.integer) -> np.ndarray:
    """The two frames learned from that are nearest to a frame in time, nearest first.

    Of its own camera where that has two to learn from, else of all cameras; of frames
    equally near, the first in the capture.
    """
    rows = capture.train
    same = rows[capture.camera_ids[rows] == capture.camera_ids[row]]
    rows = np.sort(same if len(same) >= NEIGHBORS else rows)
    apart = np.abs(capture.times[rows].astype(np.float64) - float(capture.times[row]))
    # Times are float32: a tie is within 1e-6.
    return rows[np.argsort(np.round(apart, 6), kind="stable")[:NEIGHBORS]]


def neighbor_means(capture: Capture, rows: np.ndarray) -> Averages | None:
    """The mean of the neighbors (`neighbor_rows`) of each row, as filmed.

    Each pixel is the mean of those neighbors that filmed it, and unknown where none
    did. None where there are not two frames to learn from at different times: nothing
    is nearest then.
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
    """The mean over time of what a scene draws from the cameras of some rows.

    Of at most `frames` of the rows, at most `moments` of the times that were learned
    from, both evenly spread. All else of the view (its camera, its appearance) stays.
    Colors are clipped, then averaged as stored (sRGB).
    """
    if frames < 1 or moments < 1:
        raise ValueError(
            f"an average over time needs a frame and a moment, got frames={frames} and "
            f"moments={moments}; ask for one of each at least"
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
