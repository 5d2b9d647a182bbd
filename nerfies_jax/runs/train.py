"""Train a run, with held-out scores along the way."""

import pathlib
from typing import Any, NamedTuple

import numpy as np

from nerfies_jax import evaluation, runs
from nerfies_jax.evaluation import Renderer
from nerfies_jax.runs import Run, budget
from nerfies_jax.training import loop
from nerfies_jax.training.checkpoint import Checkpoints
from nerfies_jax.training.loop import FitResult, History, Hook


class Outcome(NamedTuple):
    """A finished training, and the renderer that is compiled for it."""

    result: FitResult
    renderer: Renderer
    watched: np.ndarray  # rows of the held-out frames that its curve is of


def open_checkpoints(folder: pathlib.Path, run: Run, after: int | None) -> Checkpoints:
    """Where this run saves; ValueError where it cannot."""
    return Checkpoints(folder / runs.CHECKPOINTS, run.model.spec, after=after)


def train(
    run: Run,
    state: Any,
    record: dict | None,
    checkpoints: Checkpoints,
    *,
    seconds: float | None,
    evaluate_every: float,
    evaluated: int,
) -> Outcome:
    """Fit the model; its PSNR and SSIM on a few held-out frames go into the history."""
    renderer = Renderer(run.model, run.capture.size)
    few = run.capture.heldout
    if len(few):
        renderer(
            state, evaluation.view_of(run.capture, int(few[0]))
        )  # how long it takes
        pace = budget.evaluations(renderer.seconds[-1], evaluate_every, evaluated)
        few = evaluation.spread(run.capture.heldout, pace.frames)
        evaluate_every = pace.every_seconds

    def held_out(state, step):
        del step
        scored = evaluation.score(renderer, state, run.capture, few)
        return {"psnr": scored.psnr.mean(), "ssim": scored.ssim.mean()}

    hooks = [Hook("held out", held_out, every_seconds=evaluate_every)]
    with checkpoints:
        result = loop.fit(
            run.model,
            state,
            evaluation.frames_of(run.capture, run.model.required_data),
            steps=run.spec.steps,
            hooks=hooks if len(few) else [],
            seconds=seconds,
            checkpoints=checkpoints,
            history=History() if record is None else History(**record),
        )
    return Outcome(result, renderer, few)
