"""Forwarding of the events of a run to its folder and to experiment trackers."""

import contextlib
import pathlib
import uuid
from collections.abc import Iterator, Sequence

from nerfies_jax.metrics import clock
from nerfies_jax.runs import trackers
from nerfies_jax.runs.event_log import EventLog, read_events
from nerfies_jax.runs.run import Run
from nerfies_jax.runtime import events
from nerfies_jax.training import specs
from nerfies_jax.training.loop import FitResult


class Following:
    """Event sinks of a run, which are opened as soon as its folder exists."""

    def __init__(
        self, stack: contextlib.ExitStack, log: EventLog, names: Sequence[str]
    ):
        self._stack, self._log, self._names = stack, log, names

    def begin(self, folder: pathlib.Path, run: Run, after: int | None) -> None:
        """Begin to write events to the folder and to the trackers.

        Args:
          folder: Folder of the run.
          run: The run, which is about to be trained.
          after: Step after which it is resumed. None for a new run.

        Raises:
          ValueError: If a tracker cannot be opened.
        """
        identity = None if after is None else _identity(folder)
        identity = identity or uuid.uuid4().hex[:12]
        self._log.open(folder)
        tracked_run = trackers.TrackedRun(
            folder, identity, folder.name, specs.as_json(run.config), after or 0
        )
        for name in self._names:
            sink = self._stack.enter_context(trackers.opened(name, tracked_run))
            self._stack.enter_context(events.subscribe(sink))
        events.emit(
            "run",
            status="begin" if after is None else "resume",
            identity=identity,
            step=after or 0,
            steps=run.spec.steps,
            preset=run.config.preset,
            capture=run.capture.name,
            machine=clock.machine(),
        )

    def end(self, result: FitResult, errors: Sequence[str]) -> None:
        """Record the end of the run, after all products have been written.

        Args:
          result: Result of the training.
          errors: One line for each product that could not be written.
        """
        events.emit(
            "run",
            status="end",
            stopped_by=result.stopped_by,
            step=result.steps,
            seconds=result.seconds,
            cpu_seconds=result.history.cpu_seconds,
            compile_seconds=result.compile_seconds,
            errors=list(errors),
        )


def _identity(folder):
    """Return the identity of a run in trackers, or None if no event contains it."""
    with contextlib.suppress(ValueError):
        for event in read_events(folder):
            if event["kind"] == "run" and isinstance(event.get("identity"), str):
                return event["identity"]
    return None


@contextlib.contextmanager
def following(names: Sequence[str] = ()) -> Iterator[Following]:
    """Collect the events of a run, including those before its folder exists.

    Args:
      names: Names of trackers, keys of `trackers.TRACKERS`.

    Yields:
      The sinks. Call `begin` when the folder exists, and `end` after the run.

    Raises:
      ValueError: If a tracker is unknown or not installed.
    """
    trackers.check(names)
    log = EventLog()
    with contextlib.ExitStack() as stack:
        stack.callback(log.close)
        stack.enter_context(events.subscribe(log))
        yield Following(stack, log, names)
