"""What a step of training takes, measured before a run is planned by it."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.training import chunk
from nerfies_jax.training.model import Frames, Model, TrainState

# Shares of a run at which its step is timed: before a warm-up is over, a motion may
# cost nothing, and a penalty that begins late is seen by the first steps alone never.
PHASES = (1 / 8, 3 / 8, 5 / 8, 7 / 8)
PHASE_SECONDS = 0.4  # of steps that are timed at each
MOST_STEPS = 200
REPEATS, REPEAT_SECONDS = 5, 1.0  # of the scans that tell what a step takes


class StepTime(NamedTuple):
    """Seconds of one step, and of making its program; on the wall."""

    seconds: float
    compile_seconds: float


def step_time(model: Model, state: TrainState, frames: Frames, steps: int) -> StepTime:
    """The mean over a run of `steps` steps of what one takes with the first state.

    `state` is left as it is. Of every phase of the run, the first step is not timed.
    Whatever grows later is not seen.
    """
    program, frames, compile_seconds = chunk.compiled(model, state, frames, steps)
    length = program.length

    def timed(start, count):
        began = time.perf_counter()
        left, outcome = program(start, frames, count)
        done = max(outcome.done, 1)  # fewer where one is not finite
        return left, (time.perf_counter() - began) / done

    seconds = []
    for share in PHASES:
        # The program overwrites what it is given.
        start = jax.tree.map(jnp.copy, state)
        start = start._replace(step=jnp.full_like(state.step, int(share * steps)))
        start, _ = timed(start, length)
        start, guess = timed(start, length)
        scans = round(PHASE_SECONDS / (length * guess))
        count = length * min(max(scans, 1), MOST_STEPS // length)
        seconds.append(timed(start, count)[1])
    return StepTime(float(np.mean(seconds)), compile_seconds)


def step_ms(model: Model, state: TrainState, frames: Frames, steps: int) -> float:
    """Median milliseconds of a step from `state` on, which is left as it is.

    By the program of a run of `steps` steps: where that has trained, none is compiled.
    """
    program, frames, _ = chunk.compiled(model, state, frames, steps)
    left, seconds = jax.tree.map(jnp.copy, state), []
    while len(seconds) < REPEATS and sum(seconds) < REPEAT_SECONDS:
        began = time.perf_counter()
        left, _ = program(left, frames, program.length)  # waits
        seconds.append(time.perf_counter() - began)
    return 1e3 * float(np.median(seconds)) / program.length
