"""How many pictures a run can afford, from the time one takes.

Splats render in milliseconds, a radiance field takes seconds for a frame on a CPU: what
is made beside the training shrinks so that it does not take longer than the training.
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
FILM_LENGTH = 4.0  # seconds that the film plays
MOST_FILMED, LEAST_FILMED = 96, 24
LEAST_SIDE = 32  # pixels: a film is not made smaller than this


class Evaluations(NamedTuple):
    """How often to evaluate, and how many frames each time."""

    frames: int
    every_seconds: float  # of training


class FilmPlan(NamedTuple):
    """How many frames of which size, shown how fast."""

    frames: int
    size: tuple[int, int]  # width and height in pixels
    rate: float  # frames per second


def evaluations(frame_seconds: float, every_seconds: float, most: int) -> Evaluations:
    """Evaluations as asked for, as far as they stay a tenth of the training time.

    A slow renderer gets fewer frames first, down to one, and then longer breaks.
    """
    frames = _clamped(EVALUATION_SHARE * every_seconds, frame_seconds, 1, most)
    least = frames * frame_seconds / EVALUATION_SHARE
    return Evaluations(frames, max(every_seconds, least))


def scored(frame_seconds: float, heldout: int) -> int:
    """How many held-out frames to score at the end: all of them, where time allows."""
    return _clamped(SCORE_SECONDS, frame_seconds, min(LEAST_SCORED, heldout), heldout)


def halves(frame_seconds: float, share: float, heldout: int) -> int:
    """How many held-out frames to fit codes to; a fit costs `share` of a frame."""
    least = min(LEAST_FITTED, heldout)
    return _clamped(FIT_SECONDS, frame_seconds * (1 + share), least, heldout)


def still(frame_seconds: float, scored: int, size: tuple[int, int]) -> tuple[int, int]:
    """How many scored frames to average over time, and over how many moments.

    All frames over many moments, where time and memory allow; fewer moments first,
    then fewer frames.
    """
    scored = min(scored, max(LEAST_STILL, STILL_PIXELS // (size[0] * size[1])))
    renders = STILL_SECONDS / frame_seconds if frame_seconds > 0 else float("inf")
    moments = min(max(renders / scored, LEAST_MOMENTS), MOST_MOMENTS)
    frames = min(max(renders / moments, min(LEAST_STILL, scored)), scored)
    return int(frames), int(moments)


def film(frame_seconds: float, size: tuple[int, int]) -> FilmPlan:
    """A film that renders within its time at `frame_seconds` for a frame of `size`.

    Fewer frames first, shown slower; then pictures of half the size, a quarter of the
    time each, and so on.
    """
    while LEAST_FILMED * frame_seconds > FILM_SECONDS and min(size) // 2 >= LEAST_SIDE:
        size, frame_seconds = (size[0] // 2, size[1] // 2), frame_seconds / 4
    frames = _clamped(FILM_SECONDS, frame_seconds, LEAST_FILMED, MOST_FILMED)
    return FilmPlan(frames, size, frames / FILM_LENGTH)


def _clamped(seconds, frame_seconds, least, most):
    if frame_seconds * most <= seconds:
        return most
    return max(least, int(seconds / frame_seconds))
