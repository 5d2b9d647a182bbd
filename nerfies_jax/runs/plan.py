"""How many steps fit into the seconds that a run is given."""

import math

from nerfies_jax import evaluation, events
from nerfies_jax.runs.run import Run, with_steps
from nerfies_jax.training import rate
from nerfies_jax.training.model import TrainState

# A run is cut where it takes so many times the seconds it was planned for. A schedule
# that is cut has not come to its low rates, which costs more than the time.
OVERRUN = 1.5


@events.stage("measuring the time of a step")
def with_seconds(run: Run, state: TrainState, seconds: float | int) -> tuple[Run, str]:
    """The run over as many steps as take `seconds` of training, and the plan in words.

    Its schedules stretch with the steps; its first state does not know of them and
    stays `state`, with which is measured what a step takes (`rate.step_time`). What is
    expected of growth is the representation's word. Two digits of the steps are kept:
    the program of another run as long is then found in the compilation cache.
    """
    frames = evaluation.frames_of(run.capture, run.model.required_data)
    step = rate.step_time(run.model, state, frames, run.spec.steps)
    growth = run.representation.growth(run.spec, state)
    steps = rounded(seconds / (step.seconds * growth))
    grown = f", {growth:.2g} times that as it grows" if growth > 1 else ""
    line = (
        f"plan: {steps:,} steps for {seconds:g} s of training "
        f"({1e3 * step.seconds:.3g} ms a step now{grown}; measured after compiling for "
        f"{step.compile_seconds:.0f} s); compiling, scores and pictures come on top"
    )
    return with_steps(run, steps), line


def rounded(steps: float | int) -> int:
    """Steps to two digits, never more than were given but for the first."""
    whole = max(int(steps), 1)
    unit = 10 ** max(math.floor(math.log10(whole)) - 1, 0)
    return whole // unit * unit
