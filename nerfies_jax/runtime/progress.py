"""The progress display, a sink of events: bars on a terminal, lines in a log file."""

import contextlib
import math
import threading
import time
from typing import Any

import rich.console
import rich.progress

from nerfies_jax.runtime import console

LINE_SECONDS = 10.0  # between lines in a log file
FIRST_LINE_SECONDS = 2.0  # shorter stages have no line
BAR_SECONDS = 0.3  # bars of shorter stages would only flicker
TICK_SECONDS = 0.25


class Display:
    """Shows the open stages.

    A separate thread updates stages that emit no progress events, such as compilation.
    """

    def __init__(self, target: rich.console.Console | None = None):
        self._target = target
        self._open: dict[int, _Shown] = {}  # by number, oldest first
        self._view: _Lines | _Bars | None = None
        self._lock = threading.RLock()
        self._idle = threading.Event()

    def __call__(self, event: dict[str, Any]) -> None:
        """Receive an event."""
        with self._lock:
            if event["kind"] == "message":
                self._message(event)
            elif event["kind"] == "stage":
                self._stage(event)
            elif event["kind"] == "train":
                self._train(event)

    def _train(self, event):
        for state in reversed(self._open.values()):
            if state.name == event.get("phase"):
                state.done, state.total = event["step"], event["steps"]
                state.text, state.eta = _training_text(event), event["eta_seconds"]
                state.count_format = "step {:,} of {:,}"
                self._view.update(state)
                return

    def _message(self, event):
        prefix = "warning: " if event["level"] == "warning" else ""
        text = prefix + event["text"]
        if self._view is not None:
            self._view.write(text)
        elif self._target is not None:
            _print(self._target, text)
        else:
            console.note(text)

    def _stage(self, event):
        number = event["stage"]
        if event["status"] == "begin":
            if not self._open:
                self._start()
            self._open[number] = _Shown(event["name"])
        state = self._open.get(number)
        if state is None:  # the stage began on another display
            return
        state.done, state.total = event["done"], event["total"]
        state.text = event.get("text", state.text)
        if event["status"] in ("begin", "progress"):
            self._view.update(state)
            return
        del self._open[number]
        self._view.remove(state)
        if not self._open:
            self._idle.set()
            self._view.close()
            self._view = None

    def _start(self):
        target = self._target
        if target is None:
            target = rich.console.Console(file=console.safe("stderr"))
        on_terminal = target.is_terminal and not target.is_dumb_terminal
        if on_terminal:
            self._view = _Bars(target)
        else:
            self._view = _Lines(self._target)
        self._idle = threading.Event()
        ticker = threading.Thread(
            target=self._tick, args=(self._idle,), name="progress", daemon=True
        )
        ticker.start()

    def _tick(self, idle):
        while not idle.wait(TICK_SECONDS):
            with self._lock:
                if not idle.is_set():
                    self._view.tick(list(self._open.values()))


class _Shown:
    """State of an open stage."""

    def __init__(self, name: str):
        self.name, self.start_time = name, time.monotonic()
        self.done, self.total = 0, None
        self.text = ""
        self.eta: float | None = None  # remaining seconds, if the stage reports them
        self.count_format = "{:,} of {:,}"
        self.first = True  # no line has been written about it yet
        self.task = None  # of its bar

    @property
    def seconds(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self.start_time

    def line(self) -> str:
        """Return a line about the stage for a log."""
        parts = []
        if self.total is not None and self.done:
            parts.append(self.count_format.format(self.done, self.total))
        if self.text:
            parts.append(self.text)
        if self.eta is None and self.seconds >= LINE_SECONDS:
            parts.append(f"{duration(self.seconds)} elapsed")
        return f"{self.name}: {'  '.join(parts)}" if parts else f"{self.name} ..."


class _Lines:
    """A line about the innermost stage after two seconds, and every ten after that."""

    def __init__(self, target: rich.console.Console | None):
        self._target = target
        self._last = time.monotonic()

    def write(self, text):
        if self._target is None:
            console.note(text)
        else:
            _print(self._target, text)

    def update(self, state):
        # The speed of training is reported immediately.
        if state.first and state.eta is not None:
            self._show(state)

    def _show(self, state):
        state.first, self._last = False, time.monotonic()
        self.write(state.line())

    def tick(self, stages):
        innermost = stages[-1]
        if innermost.first:
            due = innermost.seconds >= FIRST_LINE_SECONDS
        else:
            # Without a number of items, lines become less frequent.
            wait = innermost.seconds / 2 if innermost.total is None else 0.0
            due = time.monotonic() - self._last >= max(LINE_SECONDS, wait)
        if due:
            self._show(innermost)

    def remove(self, state):
        pass

    def close(self):
        pass


class _Bars:
    """A bar for each open stage, below other lines of output."""

    def __init__(self, target: rich.console.Console):
        self._console = target
        columns = rich.progress
        self._bars = columns.Progress(
            columns.TextColumn("{task.description}"),
            columns.BarColumn(bar_width=24),
            columns.TextColumn("{task.fields[text]}"),
            console=target,
            transient=True,
            # Lines of other libraries appear above the bars, unless stdout is a file.
            redirect_stdout=console.safe("stdout").isatty(),
        )
        self._stack = contextlib.ExitStack()
        self._live = False

    def write(self, text):
        _print(self._console, text)

    def update(self, state):
        if state.task is not None:
            self._bars.update(
                state.task,
                total=state.total,
                completed=state.done,
                text=_bar_text(state),
            )

    def tick(self, stages):
        for state in stages:
            if state.task is None and state.seconds >= BAR_SECONDS:
                state.task = self._bars.add_task(state.name, total=None, text="")
            self.update(state)  # shows the elapsed time
        if not self._live and any(state.task is not None for state in stages):
            self._live = True
            self._stack.enter_context(self._bars)
            self._stack.enter_context(console.display(self.write))

    def remove(self, state):
        if state.task is not None:
            self._bars.remove_task(state.task)
        if state.seconds >= FIRST_LINE_SECONDS:
            self.write(f"{state.name}: {duration(state.seconds)}")

    def close(self):
        self._stack.close()


def _print(target, text):
    # The terminal of a console that the caller has passed may be closed.
    with contextlib.suppress(OSError, SystemExit):
        target.print(text, highlight=False, markup=False, soft_wrap=True)


def _bar_text(state):
    parts = []
    if state.total is not None:
        parts.append(f"{state.done:,}/{state.total:,}")
    if state.text:
        parts.append(state.text)
    if state.eta is None:
        remaining = _remaining_seconds(state)
        if remaining is not None:
            parts.append(f"{duration(remaining)} left")
        elif state.seconds >= FIRST_LINE_SECONDS:
            parts.append(duration(state.seconds))
    return "  ".join(parts)


def _remaining_seconds(state):
    """Estimate the remaining time, or return None if too few items are finished."""
    if not state.total or not state.done or state.seconds < FIRST_LINE_SECONDS:
        return None
    return max(0.0, state.seconds * (state.total / state.done - 1))


def _training_text(event: dict[str, Any]) -> str:
    """Describe a `train` event: speed, loss, PSNR, counts and remaining time."""
    parts = [f"{event['steps_per_second']:.3g} steps/s"]
    metrics = event["metrics"]
    if "loss" in metrics:
        parts.append(f"loss {metrics['loss']:.4g}")
    if event["psnr"] is not None and math.isfinite(event["psnr"]):
        parts.append(f"PSNR {event['psnr']:.2f} dB")
    parts += [f"{count:,} {name}" for name, count in event["counts"].items()]
    parts.append(f"{duration(event['eta_seconds'])} left")
    return "  ".join(parts)


def duration(seconds: float) -> str:
    """Format a duration as hours, minutes and seconds, such as 1:02:03 or 2:05.

    Args:
      seconds: The duration.

    Returns:
      The text.
    """
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
