"""Number of training steps that fit into a time budget."""

import math

from nerfies_jax import evaluation
from nerfies_jax.runs.run import Run, with_steps
from nerfies_jax.runtime import events
from nerfies_jax.training import rate
from nerfies_jax.training.model import TrainState

# A run is cut where it takes so many times the seconds it was planned for. A schedule
# that is cut has not come to its low rates, which costs more than the time.
OVERRUN = 1.5


@events.stage("measuring the time of a step")
def with_seconds(run: Run, state: TrainState, seconds: float | int) -> tuple[Run, str]:
    """Plan a run for a number of seconds of training.

    Its schedules are stretched to the number of steps. The step time is measured with
    the first state (`rate.step_time`), which does not depend on the number of steps,
    and the representation estimates how it grows. The number of steps is rounded to two
    digits, so that another run of the same length finds its program in the compilation
    cache.

    Args:
      run: The run.
      state: Its first state.
      seconds: Seconds of training.

    Returns:
      The run with its number of steps, and a line of text about the plan.
    """
    frames = evaluation.frames_of(run.capture, run.model.required_data)
    step = rate.step_time(run.model, state, frames, run.spec.steps)
    growth = run.representation.resources.growth(run.spec, state)
    steps = rounded(seconds / (step.seconds * growth))
    grown = f", {growth:.2g} times that as it grows" if growth > 1 else ""
    line = (
        f"plan: {steps:,} steps for {seconds:g} s of training "
        f"({1e3 * step.seconds:.3g} ms a step now{grown}; measured after compiling for "
        f"{step.compile_seconds:.0f} s); compiling, scores and pictures come on top"
    )
    return with_steps(run, steps), line


def rounded(steps: float | int) -> int:
    """Round a number of steps down to two digits.

    Args:
      steps: Number of steps.

    Returns:
      The rounded number, at least 1.
    """
    whole = max(int(steps), 1)
    unit = 10 ** max(math.floor(math.log10(whole)) - 1, 0)
    return whole // unit * unit
