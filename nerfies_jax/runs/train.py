"""Training of a run, with evaluations on held-out frames."""

import dataclasses
import math
import pathlib
from typing import Any, NamedTuple

import jax
import numpy as np

from nerfies_jax import evaluation
from nerfies_jax.evaluation import Renderer
from nerfies_jax.evaluation.representation import HalfScorer
from nerfies_jax.runs import budget, curves, run_folder, validation
from nerfies_jax.runs.run import Run
from nerfies_jax.runtime import console, data_parallel, events
from nerfies_jax.training import checkpoint, chunk, loop, losses
from nerfies_jax.training.checkpoint import Checkpoints
from nerfies_jax.training.frame_stream import FrameStream
from nerfies_jax.training.loop import FitResult, History, Hook

EVALUATED = 4  # held-out frames during training. All of them are scored at the end.


@dataclasses.dataclass(frozen=True)
class Pace:
    """Duration of training and intervals of evaluations and checkpoints, in seconds.

    Evaluations during training are of a few frames and cost at most a tenth of the
    time of training. Those at given steps are of the same frames as the final metrics.
    """

    seconds: float | int | None = None  # None for no limit
    evaluate_every: float | int = 20.0
    checkpoint_every: float | int = 60.0
    evaluate_at: tuple[int, ...] = ()  # steps, which replace `evaluate_every`

    def __post_init__(self):
        if min(self.evaluate_at, default=1) < 1:
            raise ValueError(
                f"evaluate_at={self.evaluate_at}: steps must be at least 1; the state "
                "before the first step has not been trained"
            )
        for name in ("seconds", "evaluate_every", "checkpoint_every"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ValueError(
                    f"{name}={value} must be a number of seconds, at least 0"
                )


class Trained(NamedTuple):
    """Result of training, and the compiled renderer."""

    result: FitResult
    renderer: Renderer
    watched: np.ndarray  # rows of the held-out frames evaluated during training
    scorer: HalfScorer | None = None  # of halves of frames with fitted codes


def open_checkpoints(folder: pathlib.Path, run: Run, after: int | None) -> Checkpoints:
    """Open the checkpoints of a run for writing.

    Args:
      folder: The run folder.
      run: The run.
      after: Step after which it is resumed. None for a new run.

    Returns:
      The writer.

    Raises:
      ValueError: If they cannot be written.
    """
    return Checkpoints(
        folder / run_folder.CHECKPOINTS,
        run.model.spec,
        after=after,
        beside=folder / run_folder.CONFIG,
    )


def train(
    run: Run,
    state: Any,
    record: dict | None,
    checkpoints: Checkpoints,
    pace: Pace,
    hooks: tuple[Hook, ...] = (),
) -> Trained:
    """Fit the model, with PSNR and SSIM of a few held-out frames in its history.

    Args:
      run: The run.
      state: Initial or restored state.
      record: Stored history of a restored run, or None.
      checkpoints: Writer of checkpoints.
      pace: Duration and intervals.
      hooks: Further callbacks.

    Returns:
      The result with the renderer.
    """
    renderer = Renderer(run.model, run.capture.size)
    rows, every_seconds = run.capture.heldout, pace.evaluate_every
    frames = validation.training_frames(run)
    if isinstance(frames, FrameStream):
        console.say(
            "training frames do not fit in the memory of the device, so those of the "
            "next steps are streamed to it"
        )
    # Earlier versions stored no processor time.
    history = History()
    if record is not None:
        history = History(**{"cpu_seconds": math.nan, **record})
    first = evaluation.view_of(run.capture, int(rows[0])) if len(rows) else None
    scorer = half_scorer(run)
    seconds = history.compile_seconds + _compile(run, state, frames, renderer, first)
    history = history._replace(compile_seconds=seconds)
    if first is not None:
        renderer(state, first)  # measures the time of a frame
        cost = renderer.seconds[-1] * (1 + _fit_cost(run, scorer))
        count, every_seconds = _evaluations(pace, cost, len(rows))
        rows = evaluation.spread(run.capture.heldout, count)

    def held_out(state, step, metrics):
        del step, metrics
        capture = evaluation.with_refined_cameras(run.model, state, run.observed)
        scores = evaluation.score(renderer, state, capture, rows)
        numbers = {
            "psnr": evaluation.known_mean(scores.psnr),
            "ssim": evaluation.known_mean(scores.ssim),
        }
        if scorer is None:
            return numbers
        training_capture = evaluation.with_refined_cameras(
            run.model, state, run.capture
        )
        halves = scorer(state, training_capture, rows)
        return {
            "psnr": evaluation.known_mean(halves.psnr),
            "ssim": evaluation.known_mean(halves.ssim),
            **{f"unfitted_{name}": value for name, value in numbers.items()},
        }

    if len(rows):
        names = [run.capture.ids[row] for row in rows]
        events.emit("evaluation_frames", frames=names)
        hook = Hook(curves.HELD_OUT, held_out, every_seconds=every_seconds)
        if pace.evaluate_at:
            hook = Hook(curves.HELD_OUT, held_out, at_steps=pace.evaluate_at)
        hooks = (hook, *hooks)
    hooks = (*hooks, *validation.hooks(run, renderer))
    result = loop.fit(
        run.model,
        state,
        frames,
        steps=run.spec.steps,
        hooks=hooks,
        seconds=pace.seconds,
        checkpoints=checkpoints,
        checkpoint_seconds=pace.checkpoint_every,
        history=history,
    )
    # The products then share programs with the renderer and with later commands.
    result = result._replace(state=data_parallel.uncommitted(result.state))
    result = _with_best(run, result, checkpoints)
    return Trained(result, renderer, rows, scorer)


def _evaluations(pace, frame_seconds, heldout):
    """Return the number of frames of an evaluation, and the seconds between two."""
    if pace.evaluate_at:
        return budget.scored_frames(frame_seconds, heldout), pace.evaluate_every
    return budget.evaluations(frame_seconds, pace.evaluate_every, EVALUATED)


def half_scorer(run: Run) -> HalfScorer | None:
    """Return a function that scores halves of frames with codes fitted to the others.

    Args:
      run: The run.

    Returns:
      The function. None if the model has no codes of single frames, or the halves are
      too narrow to score.
    """
    if run.capture.size[0] // 2 < len(losses.WINDOW):
        return None  # of the SSIM
    build = run.representation.scoring.half_scorer
    return build(run.spec, run.metadata, run.capture.size)


def _fit_cost(run, scorer):
    """Time to fit codes to a frame and to render it, relative to a render."""
    if scorer is None:
        return 0.0
    width, height = run.capture.size
    # A gradient takes about three times as long as a render.
    return 1 + 3 * run.representation.scoring.fitted_rays / (width * height)


def _with_best(run, result, checkpoints):
    """Replace the last state of a complete run by a better earlier one."""
    if result.stopped_by not in ("steps", "seconds"):
        return result
    outcome = validation.outcome(run, result)
    if outcome is None:
        return result
    console.say(outcome.text)
    result = result._replace(message=f"{result.message}. {outcome.text}")
    # The checkpoint is missing if the disk was full.
    if outcome.step not in {*checkpoint.steps(checkpoints.folder)} - {result.steps}:
        return result
    example = (run.model.example or run.model.init)(run.capture, jax.random.key(0))
    best_checkpoint = checkpoint.restore(
        checkpoints.folder, example, run.model.spec, step=outcome.step
    )
    return result._replace(state=best_checkpoint.state)


def _compile(run, state, frames, renderer, view) -> float:
    """Compile training and renderer concurrently, and return the time of the former."""
    scan = None
    if run.spec.steps - int(state.step) >= chunk.LENGTH:
        scan = chunk.compiling(run.model, state, frames, run.spec.steps)
    if view is not None:
        renderer.compiled(state, view)
    return 0.0 if scan is None else scan.result()
