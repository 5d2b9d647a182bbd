"""The event stream: current work, its progress and its measurements.

Code that does work calls `stage` and `emit`. Sinks, which are functions of an event,
receive every event of the process. They are the progress display of the terminal, and
those that `subscribe` adds (`events.jsonl` of a run folder, experiment trackers).

An event is a dictionary with `time` (seconds since 1970), `kind` and, inside a stage,
`phase` (the name of the innermost stage of the thread). docs/events.md lists the kinds
and their fields.
"""

import contextlib
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import rich.console

from nerfies_jax.runtime import console, progress, stopping

Event = dict[str, Any]
Sink = Callable[[Event], None]

STAGE_SECONDS = 0.2  # between two progress events of a stage

_sinks: tuple[Sink, ...] = ()
_display: Sink | None = progress.Display()
_thread = threading.local()  # `stages`: the open stages of this thread, outermost first
_numbers = itertools.count(1)


class Stage:
    """A part of the work that may take longer than two seconds.

    Attributes:
      name: Name for the user, such as `structure from motion`.
      total: Number of items, or None if it is unknown.
      done: Number of finished items.
    """

    def __init__(self, name: str, total: int | None = None, done: int = 0):
        self.name, self.total, self.done = name, total, done
        self._about: dict[str, Any] = {"stage": next(_numbers)}
        outer = open_stages()
        if outer:
            self._about["parent"] = outer[-1]._about["stage"]
        self._emit_time = -float("inf")

    def advance(self, count: int = 1, text: str | None = None) -> None:
        """Record that more items are finished.

        Args:
          count: Number of additional finished items.
          text: Text to show next to the numbers. None to keep the previous one.
        """
        self.reach(self.done + count, text=text)

    def reach(
        self, done: int, total: int | None = None, text: str | None = None
    ) -> None:
        """Record the number of finished items. If a signal has arrived, stop the work.

        Args:
          done: Number of finished items.
          total: Number of all items, if it has become known or has changed.
          text: Text to show next to the numbers. None to keep the previous one.
        """
        stopping.check()
        self.done = done
        self.total = self.total if total is None else total
        if text is not None:
            self._about["text"] = text
        if time.monotonic() - self._emit_time >= STAGE_SECONDS:
            self._emit("progress")

    def _emit(self, status, **fields):
        self._emit_time = time.monotonic()
        numbers = {"done": self.done, "total": self.total}
        emit("stage", name=self.name, status=status, **numbers, **self._about, **fields)


@contextlib.contextmanager
def stage(name: str, total: int | None = None, done: int = 0) -> Iterator[Stage]:
    """Show a named progress bar, and emit `stage` events, while the block runs.

    On a terminal the bar shows the name, the remaining time, and the number of items if
    `total` is known. Otherwise a line is written to stderr when the stage has lasted
    two seconds, and another one every ten seconds after that.

    Args:
      name: Name for the user, such as `structure from motion`.
      total: Number of items, or None for a stage without a count.
      done: Number of items that are already finished.

    Yields:
      The stage. Call its `advance` after each item.
    """
    stopping.check()
    current, start_time = Stage(name, total, done), time.monotonic()
    open_stages().append(current)
    status = "failed"
    try:
        current._emit("begin")
        yield current
        status = "done"
    finally:
        current._emit(status, seconds=round(time.monotonic() - start_time, 3))
        open_stages().remove(current)


def open_stages() -> list[Stage]:
    """Return the stages of this thread that have not ended, the innermost last."""
    if not hasattr(_thread, "stages"):
        _thread.stages = []
    return _thread.stages


def emit(kind: str, **fields: Any) -> None:
    """Send an event to every sink.

    A sink that raises an error is removed, with a warning, and does not end the run.

    Args:
      kind: Kind of the event, such as `train` or `evaluation`.
      **fields: JSON values, or floats that are not finite.
    """
    event: Event = {"time": round(time.time(), 3), "kind": kind}
    stages = open_stages()
    if stages:
        event["phase"] = stages[-1].name
    event |= fields
    for sink in (*_sinks, *([] if _display is None else [_display])):
        try:
            sink(event)
        except Exception as problem:  # libraries of trackers may raise any type
            _remove(sink)
            name = getattr(sink, "name", type(sink).__name__)
            console.warn(
                f"{name} receives no further events: {type(problem).__name__}: "
                f"{problem}"
            )


def message(text: str, level: str = "info") -> None:
    """Show a line about the work and emit it as a `message` event.

    Args:
      text: One line for the user.
      level: `"info"`, or `"warning"`, with which the line begins.
    """
    emit("message", text=text, level=level)


@contextlib.contextmanager
def subscribe(sink: Sink) -> Iterator[None]:
    """Send every event to a sink while the block runs.

    Args:
      sink: Function that receives events as dictionaries, in the thread that emits
        them, and must not change them.

    Yields:
      None.
    """
    global _sinks
    _sinks = (*_sinks, sink)
    try:
        yield
    finally:
        _remove(sink)


def _remove(sink):
    global _sinks, _display
    _sinks = tuple(each for each in _sinks if each is not sink)
    if sink is _display:
        _display = None


@contextlib.contextmanager
def shown_on(target: rich.console.Console | None) -> Iterator[None]:
    """Show progress on a console of rich while the block runs.

    Args:
      target: Console for bars and lines. With `quiet=True` it shows nothing. None keeps
        the current display, which by default uses stderr.

    Yields:
      None.
    """
    global _display
    if target is None:
        yield
        return
    before, _display = _display, None if target.quiet else progress.Display(target)
    try:
        yield
    finally:
        _display = before
