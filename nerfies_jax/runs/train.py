"""Training of a run, with evaluations on held-out frames."""

import dataclasses
import pathlib
from typing import Any, NamedTuple

import numpy as np

from nerfies_jax import evaluation
from nerfies_jax.evaluation import Renderer
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.runs import budget, run_folder
from nerfies_jax.runs.run import Run
from nerfies_jax.runtime import events
from nerfies_jax.training import chunk, loop
from nerfies_jax.training.checkpoint import Checkpoints
from nerfies_jax.training.loop import FitResult, History, Hook

EVALUATED = 4  # held-out frames during training. All of them are scored at the end.


@dataclasses.dataclass(frozen=True)
class Pace:
    """Duration of training and intervals of evaluations and checkpoints, in seconds."""

    seconds: float | int | None = None  # None for no limit
    evaluate_every: float | int = 20.0
    checkpoint_every: float | int = 60.0

    def __post_init__(self):
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
    draw: Draw  # renderer of the captured frames
    watched: np.ndarray  # rows of the held-out frames evaluated during training


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
    rows, evaluate_every = run.capture.heldout, pace.evaluate_every
    frames = evaluation.frames_of(run.capture, run.model.required_data)
    history = History() if record is None else History(**record)
    first = evaluation.view_of(run.capture, int(rows[0])) if len(rows) else None
    seconds = history.compile_seconds + _compile(run, state, frames, renderer, first)
    history = history._replace(compile_seconds=seconds)
    if first is not None:
        renderer(state, first)  # measures the time of a frame
        plan = budget.evaluations(renderer.seconds[-1], evaluate_every, EVALUATED)
        rows = evaluation.spread(run.capture.heldout, plan.frames)
        evaluate_every = plan.every_seconds

    def held_out(state, step, metrics):
        del step, metrics
        capture = evaluation.as_found(run.model, state, run.filmed)
        scored = evaluation.score(renderer, state, capture, rows)
        return {
            "psnr": evaluation.known_mean(scored.psnr),
            "ssim": evaluation.known_mean(scored.ssim),
        }

    if len(rows):
        names = [run.capture.ids[row] for row in rows]
        events.emit("evaluation_frames", frames=names)
        hooks = (Hook("held out", held_out, every_seconds=evaluate_every), *hooks)
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
    return Trained(result, renderer, renderer, rows)


def _compile(run, state, frames, renderer, view) -> float:
    """Compile training and renderer concurrently, and return the time of the former."""
    scan = None
    if run.spec.steps - int(state.step) >= chunk.LENGTH:
        scan = chunk.compiling(run.model, state, frames, run.spec.steps)
    if view is not None:
        renderer.compiled(state, view)
    return 0.0 if scan is None else scan.result()
