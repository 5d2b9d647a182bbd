"""Validation on training frames that a long run leaves out.

Held-out frames must not influence a model. A long run therefore leaves out a few of its
training frames as well, evaluates them at fixed steps, and keeps the best state.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from nerfies_jax import evaluation
from nerfies_jax.capture import frame_memory
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation import Renderer
from nerfies_jax.runs.run import Run
from nerfies_jax.training import chunk
from nerfies_jax.training.best import VALIDATION, best_step, psnr_by_step
from nerfies_jax.training.frame_stream import TrainingFrames
from nerfies_jax.training.loop import FitResult, Hook

# A run that is planned for fewer seconds has no time to overfit, and a capture with
# fewer training frames needs all of them.
MIN_SECONDS, MIN_FRAMES = 300.0, 40
SHARE, MOST = 1 / 15, 6  # of the training frames, and their largest number
EVALUATIONS = 20  # over a run
# PSNR that the last quarter of a run gains if more time would help.
GAINS_DB = 0.1


class Outcome(NamedTuple):
    """Step of the best state by validation, and a sentence for the user."""

    step: int
    text: str


def frames_to_leave_out(run: Run, seconds: float | int) -> int:
    """Return the number of training frames that a run leaves out.

    Args:
      run: The run.
      seconds: Planned seconds of training.

    Returns:
      Zero for short runs, captures with few frames, and models that train parameters
      of each frame, without which a left-out frame cannot be rendered.
    """
    frames = len(run.capture.train)
    validates = run.representation.scoring.validates(run.spec)
    if seconds < MIN_SECONDS or frames < MIN_FRAMES or not validates:
        return 0
    return min(int(SHARE * frames), MOST)


def rows(run: Run) -> np.ndarray:
    """Return the rows of the training frames that are left out, spread over time.

    Args:
      run: The run.

    Returns:
      Rows of the capture, without the first and the last frame.
    """
    count = min(run.config.validation, max(len(run.capture.train) - 2, 0))
    return spread_over_time(run.capture.train, run.capture.times, count)


def spread_over_time(train: np.ndarray, times: np.ndarray, count: int) -> np.ndarray:
    """Choose training frames to leave out of training, evenly spaced in their order.

    Args:
      train: Rows of the training frames, [training frames].
      times: Times of all frames of the capture, [frames].
      count: Number of frames to choose.

    Returns:
      Rows of the capture, without the first and the last training frame in time if
      there are more than two.
    """
    in_time = train[np.argsort(times[train], kind="stable")]
    candidates = in_time[1:-1] if len(in_time) > 2 else in_time
    places = (np.arange(count) + 0.5) * len(candidates) / max(count, 1)
    return np.sort(candidates[places.astype(int)])


def training_frames(run: Run) -> TrainingFrames:
    """Move the frames that a run trains on to the device, or stream them to it.

    Args:
      run: The run.

    Returns:
      The training frames without those left out.
    """
    return frames_for(run, _without_left_out(run))


def check_frames(run: Run) -> None:
    """Check that `training_frames` can succeed, without moving any frames.

    Args:
      run: The run.

    Raises:
      ValueError: If the device has too little memory.
    """
    capture = _without_left_out(run)
    evaluation.check_frames(run.model, capture, _training_bytes(run, capture))


def _without_left_out(run) -> Capture:
    capture, left_out = run.capture, rows(run)
    if not len(left_out):
        return capture
    train = capture.train
    return dataclasses.replace(capture, train=train[~np.isin(train, left_out)])


def frames_for(run: Run, capture: Capture) -> TrainingFrames:
    """Move the training frames of a capture to the device, or stream them to it.

    Args:
      run: The run that they are for.
      capture: Its capture, with any training frames.

    Returns:
      The training frames.
    """
    return evaluation.training_frames(run.model, capture, _training_bytes(run, capture))


def _training_bytes(run, capture) -> int:
    """Estimate the device memory that training needs in addition to the frames."""
    estimate = run.representation.resources.estimate_memory_bytes
    if estimate is None:
        return 0
    frames = frame_memory.frame_bytes(capture, run.model.devices)
    return estimate(run.spec, capture) - frames


def hooks(run: Run, renderer: Renderer) -> tuple[Hook, ...]:
    """Return the hook that evaluates the left-out frames, if there are any.

    Args:
      run: The run.
      renderer: Its renderer.

    Returns:
      At most one hook. It is called at fixed steps, so that a resumed run keeps the
      same state.
    """
    left_out = rows(run)
    if not len(left_out):
        return ()

    def evaluate(state, step, metrics):
        del step, metrics
        scores = evaluation.score(renderer, state, run.observed, left_out)
        return {"psnr": evaluation.known_mean(scores.psnr)}

    unit = EVALUATIONS * chunk.LENGTH
    interval = max(run.spec.steps // unit, 1) * chunk.LENGTH
    return (Hook(VALIDATION, evaluate, every_steps=interval),)


def outcome(run: Run, result: FitResult) -> Outcome | None:
    """Find the state to keep, and say whether more time would have helped.

    Args:
      run: The run.
      result: Result of its training.

    Returns:
      The outcome, or None if nothing was evaluated.
    """
    evaluations = result.history.evaluations
    best = best_step(evaluations)
    if best is None:
        return None
    scores = psnr_by_step(evaluations)
    last = max(scores)
    begin = f"validation on {len(rows(run))} training frames that were left out"
    if best != last:
        text = (
            f"{begin}: {scores[best]:.2f} dB after step {best:,}, and "
            f"{scores[last]:.2f} dB at the end; the state of step {best:,} is used. "
            "More time does not help this capture. More frames, larger images or fewer "
            "Gaussians may"
        )
        return Outcome(best, text)
    earlier = [psnr for step, psnr in scores.items() if step <= 0.75 * last]
    gain = scores[last] - max(earlier, default=scores[last])
    advice = "more time may help"
    if gain < GAINS_DB:
        advice = "more frames or larger images may help, but more time does not"
    text = f"{begin}: {scores[last]:.2f} dB, {gain:+.2f} dB in the last quarter; "
    return Outcome(last, text + advice)
