"""Number of training steps that fit into a time budget."""

import math

from nerfies_jax.runs import validation
from nerfies_jax.runs.run import Run, with_steps
from nerfies_jax.runtime import events
from nerfies_jax.training import rate
from nerfies_jax.training.model import TrainState

# Training ends early only after this multiple of the planned time: ending before the
# schedule has reached its low learning rates costs more quality than the time saves.
OVERRUN = 1.5


@events.stage("measuring the time of a step")
def with_seconds(run: Run, state: TrainState, seconds: float | int) -> tuple[Run, str]:
    """Set the number of steps of a run to fit a number of seconds of training.

    Schedules are rescaled to the number of steps. The step time is measured with the
    initial state (`rate.step_time`), and the representation estimates how much it grows
    during training. The number of steps is rounded to two digits, so that another run
    of the same length finds its program in the compilation cache.

    Args:
      run: The run.
      state: Its initial state.
      seconds: Seconds of training.

    Returns:
      The run with its number of steps, and a line of text about the plan.
    """
    frames = validation.training_frames(run)
    step = rate.step_time(run.model, state, frames, run.spec.steps)
    growth = run.representation.resources.growth(run.spec, state)
    steps = rounded(seconds / (step.seconds * growth))
    growing = f", expected to grow {growth:.2g} times" if growth > 1 else ""
    line = (
        f"plan: {steps:,} steps in {seconds:g} s of training "
        f"({1e3 * step.seconds:.3g} ms per step{growing}; compiling the measurement "
        f"took {step.compile_seconds:.0f} s); compilation, evaluation and rendering "
        "take additional time"
    )
    return with_steps(run, steps), line


def rounded(steps: float | int) -> int:
    """Round a number of steps down to two digits.

    Args:
      steps: Number of steps.

    Returns:
      The rounded number, at least 1.
    """
    count = max(int(steps), 1)
    unit = 10 ** max(math.floor(math.log10(count)) - 1, 0)
    return count // unit * unit
