"""Time of the parts of a training step, measured after training for the report."""

import contextlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

from nerfies_jax.runs import validation
from nerfies_jax.runs.run import Run
from nerfies_jax.runtime import events
from nerfies_jax.training.frame_stream import FrameStream
from nerfies_jax.training.model import TrainState


class Profile(NamedTuple):
    """Time of a training step by part."""

    step_ms: dict[str, float]  # by part
    notes: list[str]  # reasons why it could not be measured


@contextlib.contextmanager
def profiling(
    run: Run, state: TrainState, requested: bool = True
) -> Iterator[Callable[[], Profile]]:
    """Compile the parts of a step in the background, to time them later.

    A failure becomes a note and does not affect other products of the run. If the block
    ends with an error, pending compilations are dropped.

    Args:
      run: The run.
      state: Trained state.
      requested: False to measure nothing.

    Yields:
      A function that measures the times.
    """

    def failure(error):
        reason = f"{type(error).__name__}: {error}"
        note = f"The time of the parts of a step could not be measured: {reason}"
        return Profile({}, [note])

    def measure():
        try:
            with events.stage("timing the parts of a step"):
                return Profile(parts.ms(), [])
        except Exception as error:
            return failure(error)

    step_parts = run.representation.resources.step_parts
    if step_parts is None or not requested:
        yield lambda: Profile({}, [])
        return
    frames = validation.training_frames(run)
    if isinstance(frames, FrameStream):
        frames = frames.window(state, 1)
    try:
        with events.stage("preparing to time the parts of a step"):
            parts = step_parts(run.spec, run.metadata, run.model, state, frames)
    except Exception as error:
        profile = failure(error)
        yield lambda: profile
        return
    try:
        yield measure
    except BaseException:
        parts.drop()
        raise
