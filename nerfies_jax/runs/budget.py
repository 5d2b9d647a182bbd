"""Numbers of images to render for the evaluations and products of a run.

They follow from the time of one render. Gaussians render in milliseconds, but a frame
of a radiance field takes seconds on a CPU. Rendering must not take longer than
training.
"""

from typing import NamedTuple

EVALUATION_SHARE = 0.1  # of the training time, for evaluations during training
SCORE_SECONDS = 240.0  # for the held-out frames at the end
MIN_SCORED_FRAMES = 8
FIT_SECONDS = 60.0  # for fitting codes to held-out frames and rendering them again
MIN_FITTED_FRAMES = 2
STATIC_SECONDS = 30.0  # for averaging renders of scored frames over time
STATIC_PIXELS = 10_000_000  # of these frames together, at 24 bytes each
MIN_STATIC_FRAMES = 2
MIN_TIMESTAMPS, MAX_TIMESTAMPS = 4, 16
VIDEO_SECONDS = 45.0  # of rendering
VIDEO_DURATION = 4.0  # seconds
MIN_VIDEO_FRAMES, MAX_VIDEO_FRAMES = 24, 96
MIN_VIDEO_SIDE = 32  # pixels


class Evaluations(NamedTuple):
    """Number of frames of an evaluation, and the time between two evaluations."""

    frames: int
    every_seconds: float  # of training


class VideoPlan(NamedTuple):
    """Number of frames of a video, their size and rate."""

    frames: int
    size: tuple[int, int]  # width and height in pixels
    rate: float  # frames per second


def evaluations(frame_seconds: float, every_seconds: float, most: int) -> Evaluations:
    """Limit evaluations to a tenth of the training time.

    For a slow renderer, first the number of frames is reduced, down to one, and then
    the interval is extended.

    Args:
      frame_seconds: Seconds to render one frame.
      every_seconds: Requested seconds of training between evaluations.
      most: Largest number of frames.

    Returns:
      Number of frames and interval.
    """
    budget = EVALUATION_SHARE * every_seconds
    frames = _affordable(budget, frame_seconds, 1, most)
    min_interval = frames * frame_seconds / EVALUATION_SHARE
    return Evaluations(frames, max(every_seconds, min_interval))


def scored_frames(frame_seconds: float, heldout: int) -> int:
    """Return the number of held-out frames to evaluate at the end.

    Args:
      frame_seconds: Seconds to render one frame.
      heldout: Number of held-out frames.

    Returns:
      All of them, or as many as time allows.
    """
    least = min(MIN_SCORED_FRAMES, heldout)
    return _affordable(SCORE_SECONDS, frame_seconds, least, heldout)


def fitted_frames(frame_seconds: float, share: float, heldout: int) -> int:
    """Return the number of held-out frames to fit codes to.

    Args:
      frame_seconds: Seconds to render one frame.
      share: Time of a fit as a multiple of the time of a render.
      heldout: Number of held-out frames.

    Returns:
      The number of frames.
    """
    least = min(MIN_FITTED_FRAMES, heldout)
    return _affordable(FIT_SECONDS, frame_seconds * (1 + share), least, heldout)


def static_renders(
    frame_seconds: float, scored: int, size: tuple[int, int]
) -> tuple[int, int]:
    """Return the numbers of held-out frames and timestamps for static renders.

    Time and memory first limit the timestamps that a render is averaged over, and then
    the frames.

    Args:
      frame_seconds: Seconds to render one frame.
      scored: Number of evaluated frames.
      size: Width and height of a frame in pixels.

    Returns:
      Number of frames and number of timestamps.
    """
    in_memory = max(MIN_STATIC_FRAMES, STATIC_PIXELS // (size[0] * size[1]))
    most = min(scored, in_memory)
    renders = STATIC_SECONDS / frame_seconds if frame_seconds > 0 else float("inf")
    timestamps = min(max(renders / most, MIN_TIMESTAMPS), MAX_TIMESTAMPS)
    frames = min(max(renders / timestamps, min(MIN_STATIC_FRAMES, most)), most)
    return int(frames), int(timestamps)


def video(frame_seconds: float, size: tuple[int, int]) -> VideoPlan:
    """Plan a video that renders within `VIDEO_SECONDS`.

    First the number and rate of frames is reduced, and then their size is halved until
    they can be rendered in time. Halving the size divides the time by four.

    Args:
      frame_seconds: Seconds to render one frame of `size`.
      size: Width and height of a frame in pixels.

    Returns:
      The plan.
    """
    while (
        MIN_VIDEO_FRAMES * frame_seconds > VIDEO_SECONDS
        and min(size) // 2 >= MIN_VIDEO_SIDE
    ):
        size, frame_seconds = (size[0] // 2, size[1] // 2), frame_seconds / 4
    frames = _affordable(
        VIDEO_SECONDS, frame_seconds, MIN_VIDEO_FRAMES, MAX_VIDEO_FRAMES
    )
    return VideoPlan(frames, size, frames / VIDEO_DURATION)


def _affordable(seconds, frame_seconds, least, most):
    """Number of frames that can be rendered in a time, between `least` and `most`."""
    if frame_seconds * most <= seconds:
        return most
    return max(least, int(seconds / frame_seconds))
