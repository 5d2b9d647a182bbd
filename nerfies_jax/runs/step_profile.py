"""Time of the parts of a training step, measured after a run for its report."""

import contextlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

from nerfies_jax import evaluation
from nerfies_jax.runs.run import Run
from nerfies_jax.training.model import TrainState


class Profile(NamedTuple):
    """Time of a training step by part."""

    step_ms: dict[str, float]  # by part
    notes: list[str]  # why it is not known


@contextlib.contextmanager
def profiling(run: Run, state: TrainState) -> Iterator[Callable[[], Profile]]:
    """Compile the parts of a step in the background, to time them later.

    A failure becomes a note, so the run keeps all its other products. If the block ends
    with an error, pending compilations are dropped.

    Args:
      run: The run.
      state: Trained state.

    Yields:
      A function that measures the times.
    """

    def refused(error):
        words = f"{type(error).__name__}: {error}"
        return Profile({}, [f"Where the time of a step goes is not known: {words}"])

    def timed():
        try:
            return Profile(parts.ms(), [])
        except Exception as error:
            return refused(error)

    step_parts = run.representation.resources.step_parts
    if step_parts is None:
        yield lambda: Profile({}, [])
        return
    frames = evaluation.frames_of(run.capture, run.model.required_data)
    try:
        parts = step_parts(run.spec, run.metadata, run.model, state, frames)
    except Exception as error:
        profile = refused(error)
        yield lambda: profile
        return
    try:
        yield timed
    except BaseException:
        parts.drop()
        raise
