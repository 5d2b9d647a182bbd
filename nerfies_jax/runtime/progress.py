"""The progress display: named bars on a terminal, a few lines elsewhere.

It is a sink of events and knows the work only by them.
"""

import contextlib
import math
import threading
import time
from typing import Any

import rich.console
import rich.progress

from nerfies_jax.runtime import console

LINE_SECONDS = 10.0  # between lines in a log file
FIRST_LINE_SECONDS = 2.0  # a shorter stage is not worth a line
BAR_SECONDS = 0.3  # a shorter stage would only flicker
TICK_SECONDS = 0.25


class Display:
    """Shows the stages that are open, by their events.

    A thread of its own shows stages that say nothing while they last, as compilation.
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
        for shown in reversed(self._open.values()):
            if shown.name == event.get("phase"):
                shown.done, shown.total = event["step"], event["steps"]
                shown.text, shown.eta = training_text(event), event["eta_seconds"]
                shown.counted = "step {:,} of {:,}"
                self._view.update(shown)
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
        shown = self._open.get(number)
        if shown is None:  # begun on another display
            return
        shown.done, shown.total = event["done"], event["total"]
        shown.text = event.get("text", shown.text)
        if event["status"] in ("begin", "progress"):
            self._view.update(shown)
            return
        del self._open[number]
        self._view.remove(shown)
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
        waiting = threading.Thread(
            target=self._tick, args=(self._idle,), name="progress", daemon=True
        )
        waiting.start()

    def _tick(self, idle):
        while not idle.wait(TICK_SECONDS):
            with self._lock:
                if not idle.is_set():
                    self._view.tick(list(self._open.values()))


class _Shown:
    """A stage that is open, as it is shown."""

    def __init__(self, name: str):
        self.name, self.began = name, time.monotonic()
        self.done, self.total = 0, None
        self.text = ""
        self.eta: float | None = None  # seconds that remain, where the stage says so
        self.counted = "{:,} of {:,}"
        self.first = True  # nothing was shown of it yet
        self.task = None  # of its bar

    @property
    def seconds(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self.began

    def line(self) -> str:
        """Return the line of a log about the stage."""
        parts = []
        if self.total is not None and self.done:
            parts.append(self.counted.format(self.done, self.total))
        if self.text:
            parts.append(self.text)
        if self.eta is None and self.seconds >= LINE_SECONDS:
            parts.append(f"{duration(self.seconds)} so far")
        return f"{self.name}: {'  '.join(parts)}" if parts else f"{self.name} ..."


class _Lines:
    """A line when a stage has lasted two seconds, and then every ten seconds."""

    def __init__(self, target: rich.console.Console | None):
        self._target = target
        self._last = time.monotonic()

    def write(self, text):
        if self._target is None:
            console.note(text)
        else:
            _print(self._target, text)

    def update(self, shown):
        # Training says at once how fast it is.
        if shown.first and shown.eta is not None:
            self._show(shown)

    def _show(self, shown):
        shown.first, self._last = False, time.monotonic()
        self.write(shown.line())

    def tick(self, stages):
        innermost = stages[-1]
        if innermost.first:
            due = innermost.seconds >= FIRST_LINE_SECONDS
        else:
            # Without a count there is less and less to say.
            wait = innermost.seconds / 2 if innermost.total is None else 0.0
            due = time.monotonic() - self._last >= max(LINE_SECONDS, wait)
        if due:
            self._show(innermost)

    def remove(self, shown):
        pass

    def close(self):
        pass


class _Bars:
    """A bar for each stage that is open, below the lines that are written meanwhile."""

    def __init__(self, target: rich.console.Console):
        self._console = target
        columns = rich.progress
        self._bars = columns.Progress(
            columns.TextColumn("{task.description}"),
            columns.BarColumn(bar_width=24),
            columns.TextColumn("{task.fields[text]}"),
            console=target,
            transient=True,
            # Lines of other libraries stay above the bars; a file gets its own lines.
            redirect_stdout=console.safe("stdout").isatty(),
        )
        self._held = contextlib.ExitStack()
        self._live = False

    def write(self, text):
        _print(self._console, text)

    def update(self, shown):
        if shown.task is not None:
            self._bars.update(
                shown.task,
                total=shown.total,
                completed=shown.done,
                text=_bar_text(shown),
            )

    def tick(self, stages):
        for shown in stages:
            if shown.task is None and shown.seconds >= BAR_SECONDS:
                shown.task = self._bars.add_task(shown.name, total=None, text="")
            self.update(shown)  # the time goes on
        if not self._live and any(shown.task is not None for shown in stages):
            self._live = True
            self._held.enter_context(self._bars)
            self._held.enter_context(console.display(self.write))

    def remove(self, shown):
        if shown.task is not None:
            self._bars.remove_task(shown.task)
        if shown.seconds >= FIRST_LINE_SECONDS:
            self.write(f"{shown.name}: {duration(shown.seconds)}")

    def close(self):
        self._held.close()


def _print(target, text):
    # A console of the caller's may be on a terminal that was closed.
    with contextlib.suppress(OSError, SystemExit):
        target.print(text, highlight=False, markup=False, soft_wrap=True)


def _bar_text(shown):
    parts = []
    if shown.total is not None:
        parts.append(f"{shown.done:,}/{shown.total:,}")
    if shown.text:
        parts.append(shown.text)
    if shown.eta is None:
        left = _seconds_left(shown)
        if left is not None:
            parts.append(f"{duration(left)} left")
        elif shown.seconds >= FIRST_LINE_SECONDS:
            parts.append(duration(shown.seconds))
    return "  ".join(parts)


def _seconds_left(shown):
    """Remaining time by the number of finished items, or None if there are too few."""
    if not shown.total or not shown.done or shown.seconds < FIRST_LINE_SECONDS:
        return None
    return max(0.0, shown.seconds * (shown.total / shown.done - 1))


def training_text(event: dict[str, Any]) -> str:
    """Describe a `train` event: speed, loss, PSNR, counts and remaining time.

    Args:
      event: The event.

    Returns:
      The text.
    """
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
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
