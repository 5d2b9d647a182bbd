"""Point tracks through a video, realigned with the frames in which they begin."""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.view_set import Views

# Starting points: columns of a grid over the width of an image, and interval between
# frames with a grid. These are about 10,000 tracks for 60 frames of any size.
GRID_STEPS, EVERY_FRAMES = 29, 3
MOST_ON_MASK = 20_000  # starting points on moving pixels
MOST_PLACES = 30_000_000  # tracks times frames, at about 30 bytes each
SHORTEST = 8  # minimum number of frames
# Errors of flow accumulate along a track, so each point is aligned with the frame in
# which it began. This halves the 95 % quantile of the drift of static points.
WINDOW_PX, FARTHEST_PX = 9, 1.5
TRACK_PX = 0.3  # error of a track, for weights
ROUNDS, PRECISION_PX = 20, 0.01  # of Lucas-Kanade, in enlarged pixels
LEAST_EIGENVALUE = 1e-4  # minimum for the structure tensor of the window


class Tracks(NamedTuple):
    """Positions of points in each frame."""

    start: np.ndarray  # [tracks] frame in which each begins
    pixel: np.ndarray  # [tracks, frames, 2] float32, 0 if not visible
    visible: np.ndarray  # [tracks, frames] bool, True if visible

    def take(self, which: np.ndarray | slice) -> "Tracks":
        """Select tracks.

        Args:
          which: Indices, mask or slice.

        Returns:
          The selected tracks.
        """
        return Tracks(*(part[which] for part in self))


Record = TypeVar("Record", bound=tuple)


def joined(records: Sequence[Record]) -> Record:
    """Concatenate records of tracks.

    Args:
      records: Named tuples of one kind, such as `Tracks`, of arrays over tracks.

    Returns:
      The record of all tracks.
    """
    return type(records[0])(*map(np.concatenate, zip(*records, strict=True)))


def pixel_of(
    place: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel that contains each position, clamped to the image.

    Args:
      place: Positions (x, y) with centers at +0.5, [..., 2].
      shape: Height and width of the image in pixels.

    Returns:
      Rows and columns, [...].
    """
    column, row = np.moveaxis(np.floor(place).astype(int), -1, 0)
    return np.clip(row, 0, shape[0] - 1), np.clip(column, 0, shape[1] - 1)


def grid(views: Views, sparser: int = 1, seed: int = 0) -> np.ndarray:
    """Return starting points of tracks: a shifted grid in every third frame.

    Points on a plain background or on unobserved pixels are excluded. For long videos
    fewer frames are used, so that tracks have at most `MOST_PLACES` positions in all
    frames together.

    Args:
      views: The frames.
      sparser: Factor by which the number of frames is reduced.
      seed: Seed of the shifts.

    Returns:
      Frame, column and row in pixels, [starts, 3].
    """
    rng = np.random.default_rng(seed)
    width, height = views.size
    step = width / GRID_STEPS
    starts, frames = [], len(views.row)
    most = int(width / step + 1) * int(height / step + 1) * (frames // EVERY_FRAMES + 1)
    sparser *= math.ceil(most * frames / MOST_PLACES)
    for frame in range(0, frames, sparser * EVERY_FRAMES):
        x, y = rng.uniform(1, 1 + step, 2)
        x, y = np.meshgrid(
            np.arange(x, width - 1, step), np.arange(y, height - 1, step)
        )
        pixel = np.stack([x.ravel(), y.ravel()], axis=-1)
        visible = views.valid[frame][pixel[:, 1].astype(int), pixel[:, 0].astype(int)]
        at = np.full((visible.sum(), 1), frame)
        starts.append(np.concatenate([at, pixel[visible]], axis=-1))
    return np.concatenate(starts)


def grid_on(mask: np.ndarray, every: int = 1, seed: int = 0) -> np.ndarray:
    """Return starting points on the pixels of a mask, on a finer grid.

    Args:
      mask: Pixels to start from, [frames, height, width] bool.
      every: Interval between frames with starting points.
      seed: Seed for the choice if there are more than `MOST_ON_MASK`, or more than
        `MOST_PLACES` in all frames together.

    Returns:
      Frame, column and row in pixels, [starts, 3].
    """
    step = max(round(mask.shape[2] / GRID_STEPS / 2), 1)
    starts = np.argwhere(mask[::every, ::step, ::step])[:, [0, 2, 1]]
    starts = starts * [every, step, step]
    most = min(MOST_ON_MASK, MOST_PLACES // len(mask))
    if len(starts) > most:
        rng = np.random.default_rng(seed)
        starts = starts[np.sort(rng.choice(len(starts), most, replace=False))]
    return starts + np.array([0, 0.5, 0.5])


def work(views: Views, sparser: int = 1) -> int:
    """Return the work of the tracks of a grid.

    Args:
      views: The frames.
      sparser: As for `grid`.

    Returns:
      Number of starting points times number of frames.
    """
    return len(grid(views, sparser)) * len(views.row)


def chain(flow: NeighborFlow, starts: np.ndarray) -> Tracks:
    """Track points from frame to frame in both directions until flow is inconsistent.

    Args:
      flow: Flow between neighboring frames.
      starts: Frame, column and row in pixels, [tracks, 3], as from `grid`.

    Returns:
      The tracks.
    """
    frames = len(flow.forward)
    count, each = len(starts), np.arange(len(starts))
    start = starts[:, 0].astype(int)
    pixel = np.zeros((count, frames, 2), np.float32)
    visible = np.zeros((count, frames), bool)
    pixel[each, start], visible[each, start] = starts[:, 1:], True
    sides = ((1, flow.forward, flow.forward_valid), (-1, *flow[2:]))
    for sign, shift, usable in sides:
        for here in range(frames)[::sign]:
            there = here + sign
            if not 0 <= there < frames:
                continue
            # Only tracks that began earlier in this direction.
            goes = np.flatnonzero(visible[:, here] & (sign * (here - start) >= 0))
            target, valid = _step(pixel[goes, here], shift[here], usable[here])
            pixel[goes[valid], there], visible[goes[valid], there] = target[valid], True
    return Tracks(start, pixel, visible)


def _step(pixel, shift, usable):
    """Move pixels by bilinearly interpolated flow, and return their validity."""
    height, width = usable.shape
    bound = np.array([width, height])
    valid = usable[pixel_of(pixel, usable.shape)]
    corner = np.clip(np.floor(pixel - 0.5).astype(int), 0, bound - 2)
    part = np.clip(pixel - 0.5 - corner, 0, 1)
    total, sum_of_weights = 0.0, 0.0
    for right in (0, 1):
        for down in (0, 1):
            x, y = corner[:, 0] + right, corner[:, 1] + down
            weight = np.abs(1 - right - part[:, 0]) * np.abs(1 - down - part[:, 1])
            weight = (weight * usable[y, x])[:, None]
            total, sum_of_weights = (
                total + weight * shift[y, x],
                sum_of_weights + weight,
            )
    target = pixel + total / np.maximum(sum_of_weights, 1e-6)
    valid &= ((target > 0.5) & (target < bound - 0.5)).all(-1)
    return target, valid


def long_enough(tracks: Tracks, frames: int = SHORTEST) -> Tracks:
    """Select long tracks.

    Args:
      tracks: The tracks.
      frames: Minimum number of frames. In shorter videos, tracks span all frames.

    Returns:
      The long ones.
    """
    return tracks.take(tracks.visible.sum(1) >= min(frames, tracks.visible.shape[1]))


def realigned(tracks: Tracks, images: np.ndarray, size: tuple[int, int]) -> Tracks:
    """Align each point with the image in which it begins, by Lucas-Kanade.

    The search starts at the position from flow, without a pyramid. Observations that
    move too far are marked as invisible.

    Args:
      tracks: The tracks.
      images: Enlarged images from `dense_flow.leveled`.
      size: Width and height in pixels of the images of the tracks.

    Returns:
      The tracks.
    """
    times = images.shape[2] // size[0]
    pixel, visible = tracks.pixel.copy(), tracks.visible.copy()
    criteria = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, ROUNDS, PRECISION_PX
    for start in np.unique(tracks.start):
        rows = np.flatnonzero(tracks.start == start)
        for frame in np.flatnonzero(tracks.visible[rows].any(0)):
            if frame == start:
                continue
            which = rows[tracks.visible[rows, frame]]
            first = _enlarge(tracks.pixel[which, start], times)
            guess = _enlarge(tracks.pixel[which, frame], times)
            place, status, _ = cv2.calcOpticalFlowPyrLK(
                images[start],
                images[frame],
                first,
                guess.copy(),
                winSize=(WINDOW_PX, WINDOW_PX),
                maxLevel=0,
                criteria=criteria,
                flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
                minEigThreshold=LEAST_EIGENVALUE,
            )
            shift = np.linalg.norm(place - guess, axis=-1) / times
            fits = (status.ravel() == 1) & (shift < FARTHEST_PX)
            pixel[which, frame] = (place + 0.5) / times
            visible[which[~fits], frame] = False
    return Tracks(tracks.start, np.where(visible[..., None], pixel, 0), visible)


def _enlarge(pixel, times):
    # In OpenCV the first pixel has its center at 0, here centers are at +0.5.
    return np.ascontiguousarray(pixel * times - 0.5, np.float32)


def from_flow(
    views: Views,
    flow: NeighborFlow,
    images: np.ndarray,
    starts: np.ndarray | None = None,
    shortest: int = SHORTEST,
) -> Tracks:
    """Track points through a video.

    Args:
      views: The frames.
      flow: Flow between neighboring frames.
      images: Enlarged images from `dense_flow.leveled`.
      starts: Starting points. None for those of `grid`.
      shortest: Minimum number of frames of a track.

    Returns:
      Long tracks, static and moving ones.
    """
    starts = grid(views) if starts is None else starts
    tracks = long_enough(chain(flow, starts), shortest)
    return long_enough(realigned(tracks, images, views.size), shortest)
