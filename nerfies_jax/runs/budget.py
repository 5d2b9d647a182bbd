"""Number of images that a run can afford, from the time of one.

Gaussians render in milliseconds, and a radiance field takes seconds for a frame on a
CPU. Products of a run are reduced so that they do not take longer than training.
"""

from typing import NamedTuple

EVALUATION_SHARE = 0.1  # of the training time, for the evaluations beside it
SCORE_SECONDS = 240.0  # for the held-out frames at the end
LEAST_SCORED = 8
FIT_SECONDS = 60.0  # for fitting codes to held-out frames and drawing them again
LEAST_FITTED = 2
STILL_SECONDS = 30.0  # for what scored frames show at other moments
STILL_PIXELS = 10_000_000  # of these frames together, 24 bytes each
LEAST_STILL, LEAST_MOMENTS, MOST_MOMENTS = 2, 4, 16
FILM_SECONDS = 45.0  # of rendering
FILM_LENGTH = 4.0  # seconds that the video plays
MOST_FILMED, LEAST_FILMED = 96, 24
LEAST_SIDE = 32  # pixels: a video is not made smaller than this


class Evaluations(NamedTuple):
    """Number of frames of an evaluation, and the time between two of them."""

    frames: int
    every_seconds: float  # of training


class FilmPlan(NamedTuple):
    """Number of frames of a video, their size and rate."""

    frames: int
    size: tuple[int, int]  # width and height in pixels
    rate: float  # frames per second


def evaluations(frame_seconds: float, every_seconds: float, most: int) -> Evaluations:
    """Limit evaluations to a tenth of the training time.

    A slow renderer first gets fewer frames, down to one, and then longer intervals.

    Args:
      frame_seconds: Seconds to render one frame.
      every_seconds: Requested seconds of training between evaluations.
      most: Largest number of frames.

    Returns:
      Number of frames and interval.
    """
    frames = _clamped(EVALUATION_SHARE * every_seconds, frame_seconds, 1, most)
    least = frames * frame_seconds / EVALUATION_SHARE
    return Evaluations(frames, max(every_seconds, least))


def scored(frame_seconds: float, heldout: int) -> int:
    """Return the number of held-out frames to evaluate at the end.

    Args:
      frame_seconds: Seconds to render one frame.
      heldout: Number of held-out frames.

    Returns:
      All of them, or as many as time allows.
    """
    return _clamped(SCORE_SECONDS, frame_seconds, min(LEAST_SCORED, heldout), heldout)


def halves(frame_seconds: float, share: float, heldout: int) -> int:
    """Return the number of held-out frames to fit codes to.

    Args:
      frame_seconds: Seconds to render one frame.
      share: Cost of a fit in rendered frames.
      heldout: Number of held-out frames.

    Returns:
      The number of frames.
    """
    least = min(LEAST_FITTED, heldout)
    return _clamped(FIT_SECONDS, frame_seconds * (1 + share), least, heldout)


def still(frame_seconds: float, scored: int, size: tuple[int, int]) -> tuple[int, int]:
    """Return the number of held-out frames to average over time, and of timestamps.

    Time and memory limit the timestamps first, and then the frames.

    Args:
      frame_seconds: Seconds to render one frame.
      scored: Number of evaluated frames.
      size: Width and height of a frame in pixels.

    Returns:
      Number of frames and number of timestamps.
    """
    scored = min(scored, max(LEAST_STILL, STILL_PIXELS // (size[0] * size[1])))
    renders = STILL_SECONDS / frame_seconds if frame_seconds > 0 else float("inf")
    moments = min(max(renders / scored, LEAST_MOMENTS), MOST_MOMENTS)
    frames = min(max(renders / moments, min(LEAST_STILL, scored)), scored)
    return int(frames), int(moments)


def film(frame_seconds: float, size: tuple[int, int]) -> FilmPlan:
    """Plan a video that renders within `FILM_SECONDS`.

    It first gets fewer frames at a lower rate, and then images of half the size, which
    take a quarter of the time each, and so on.

    Args:
      frame_seconds: Seconds to render one frame of `size`.
      size: Width and height of a frame in pixels.

    Returns:
      The plan.
    """
    while LEAST_FILMED * frame_seconds > FILM_SECONDS and min(size) // 2 >= LEAST_SIDE:
        size, frame_seconds = (size[0] // 2, size[1] // 2), frame_seconds / 4
    frames = _clamped(FILM_SECONDS, frame_seconds, LEAST_FILMED, MOST_FILMED)
    return FilmPlan(frames, size, frames / FILM_LENGTH)


def _clamped(seconds, frame_seconds, least, most):
    if frame_seconds * most <= seconds:
        return most
    return max(least, int(seconds / frame_seconds))
