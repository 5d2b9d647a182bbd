"""Measurement of the time of a training step, to plan a run."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.training import chunk
from nerfies_jax.training.frame_stream import TrainingFrames
from nerfies_jax.training.model import Model, TrainState

# Fractions of a run at which a step is timed. A motion may cost nothing during its
# warm-up, and a penalty may start late.
PHASES = (1 / 8, 3 / 8, 5 / 8, 7 / 8)
PHASE_SECONDS = 0.4  # duration of the timed steps of each phase
MOST_STEPS = 200
REPEATS, REPEAT_SECONDS = 5, 1.0  # maximum number and duration of scans in `step_ms`


class StepTime(NamedTuple):
    """Wall-clock seconds of one step, and of compiling its program."""

    seconds: float
    compile_seconds: float


def step_time(
    model: Model, state: TrainState, frames: TrainingFrames, steps: int
) -> StepTime:
    """Measure the mean time of a step over a run, using the initial state.

    Steps are timed at several `PHASES` of the run, after a first scan that is not
    timed. Growth of the state during the run is not accounted for.

    Args:
      model: The model.
      state: Initial state, which is not changed.
      frames: Training frames.
      steps: Number of steps of the run.

    Returns:
      Seconds per step and seconds of compilation.
    """
    program, frames, compile_seconds = chunk.compile_program(
        model, state, frames, steps
    )
    length = program.length

    def time_steps(start, count):
        began = time.perf_counter()
        end, outcome = program(start, frames, count)
        done_steps = max(outcome.done, 1)  # less than `count` if a step is not finite
        return end, (time.perf_counter() - began) / done_steps

    seconds = []
    for fraction in PHASES:
        # A copy, because the program overwrites its input.
        start = jax.tree.map(jnp.copy, state)
        start = start._replace(step=jnp.full_like(state.step, int(fraction * steps)))
        start, _ = time_steps(start, length)
        start, estimate = time_steps(start, length)
        scans = round(PHASE_SECONDS / (length * estimate))
        count = length * min(max(scans, 1), MOST_STEPS // length)
        seconds.append(time_steps(start, count)[1])
    return StepTime(float(np.mean(seconds)), compile_seconds)


def step_ms(
    model: Model, state: TrainState, frames: TrainingFrames, steps: int
) -> float:
    """Measure the median time of a step, starting from a state.

    The program is that of a run of `steps` steps, so nothing is compiled if such a run
    has trained.

    Args:
      model: The model.
      state: Training state, which is not changed.
      frames: Training frames.
      steps: Number of steps of the run.

    Returns:
      Milliseconds per step.
    """
    program, frames, _ = chunk.compile_program(model, state, frames, steps)
    current = jax.tree.map(jnp.copy, state)
    seconds: list[float] = []
    while len(seconds) < REPEATS and sum(seconds) < REPEAT_SECONDS:
        began = time.perf_counter()
        current, _ = program(current, frames, program.length)  # blocks until done
        seconds.append(time.perf_counter() - began)
    return 1e3 * float(np.median(seconds)) / program.length
