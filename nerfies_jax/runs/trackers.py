"""Experiment trackers: scalars of a run for TensorBoard, Weights & Biases and rerun.

Each is a sink of events that uses the library of the tracker (extra `log`).
"""

import contextlib
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from nerfies_jax.capture import extras
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.runtime.events import Event, Sink

PROJECT = "nerfies-jax"


class TrackedRun(NamedTuple):
    """Description of a run for a tracker."""

    folder: pathlib.Path
    identity: str  # stays the same when the run is resumed
    name: str
    config: dict[str, Any]  # JSON values
    step: int  # after which it begins or is resumed


def scalars(event: Event) -> dict[str, float]:
    """Collect the numbers of an event.

    Args:
      event: An event.

    Returns:
      Numbers by name, such as `train/loss` or `held_out/psnr`.
    """
    if event["kind"] == "train":
        values = {
            "psnr": event["psnr"],
            "steps_per_second": event["steps_per_second"],
            "memory_bytes": event["memory_bytes"],
            **event["counts"],
            **event["metrics"],
        }
        prefix = "train"
    elif event["kind"] == "evaluation":
        values, prefix = event["metrics"], event["hook"].replace(" ", "_")
    else:
        return {}
    return {f"{prefix}/{k}": float(x) for k, x in values.items() if x is not None}


class TensorBoard:
    """Writes event files to `tensorboard` in the run folder."""

    name = "tensorboard"

    def __init__(self, run: TrackedRun):
        library = extras.library("tensorboardX", "log")
        # Hides the first version of steps that a resumed run repeats.
        self._writer = library.SummaryWriter(
            str(run.folder / "tensorboard"), purge_step=run.step + 1
        )

    def __call__(self, event: Event) -> None:
        """Receive an event."""
        for name, value in scalars(event).items():
            self._writer.add_scalar(name, value, event["step"], event["time"])

    def close(self) -> None:
        """Write pending data."""
        self._writer.close()


class WeightsAndBiases:
    """Logs to Weights & Biases, configured by `wandb login` and WANDB_* variables."""

    name = "wandb"

    def __init__(self, run: TrackedRun):
        library = extras.library("wandb", "log")
        try:
            self._run = library.init(
                project=PROJECT,
                id=run.identity,
                name=run.name,
                config=run.config,
                dir=str(run.folder),
                resume="allow",
            )
        except Exception as error:  # such as a missing login or network
            raise ValueError(
                f"Weights & Biases could not start ({error}); log in with `wandb "
                "login`, or set WANDB_MODE=offline and upload later with `wandb sync`"
            ) from error

    def __call__(self, event: Event) -> None:
        """Receive an event."""
        numbers = scalars(event)
        if numbers:
            # A metric, because the step of W&B cannot decrease as ours does when a
            # killed run is resumed.
            self._run.log({**numbers, "step": event["step"]})

    def close(self) -> None:
        """Write pending data."""
        self._run.finish()


class Rerun:
    """Writes recordings for the rerun viewer to `rerun/STEP.rrd` in the run folder."""

    name = "rerun"

    def __init__(self, run: TrackedRun):
        self._library = extras.library("rerun", "log")
        folder = run.folder / "rerun"
        folder.mkdir(exist_ok=True)
        self._stream = self._library.RecordingStream(PROJECT, recording_id=run.identity)
        # Each resumption writes another file, which the viewer merges by recording id.
        self._stream.save(folder / f"{run.step}.rrd")
        self._stream.send_recording_name(run.name)

    def __call__(self, event: Event) -> None:
        """Receive an event."""
        for name, value in scalars(event).items():
            self._stream.set_time("step", sequence=event["step"])
            self._stream.set_time("training", duration=event["seconds"])
            self._stream.log(name, self._library.Scalars(value))

    def close(self) -> None:
        """Write pending data."""
        self._stream.flush()
        self._stream.disconnect()


TRACKERS = {each.name: each for each in (TensorBoard, WeightsAndBiases, Rerun)}
PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb", "rerun": "rerun"}


def check(names: Sequence[str]) -> None:
    """Check that trackers are known and installed.

    Args:
      names: Keys of `TRACKERS`.

    Raises:
      ValueError: If one is not.
    """
    for name in names:
        if name not in TRACKERS:
            raise ValueError(f"no tracker {name!r}; {known_names(name, TRACKERS)}")
        extras.check(PACKAGES[name], "log")


@contextlib.contextmanager
def opened(name: str, run: TrackedRun) -> Iterator[Sink]:
    """Open a tracker for the duration of the block.

    Args:
      name: A key of `TRACKERS`.
      run: Description of the run.

    Yields:
      The sink, to be subscribed to the events.
    """
    tracker = TRACKERS[name](run)
    try:
        yield tracker
    finally:
        # An error of a tracker must not fail the run.
        with contextlib.suppress(Exception):
            tracker.close()
