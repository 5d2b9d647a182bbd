"""Writer and reader of `events.jsonl`, the event stream in a run folder.

It has one JSON object per line. A resumed run appends to it. It can be read during the
run. docs/events.md lists the kinds of events and their fields.
"""

import contextlib
import json
import math
import os
import pathlib
import threading
import time
from collections.abc import Mapping
from typing import Any

from nerfies_jax.runtime import console
from nerfies_jax.runtime.events import Event

EVENTS = "events.jsonl"
MIN_INTERVAL_S = 0.5  # between two train events, or progress events of a stage
# The interval is also at least this share of the time since the log was opened, so that
# a day has some 17,000 train events instead of 170,000.
INTERVAL_SHARE = 1 / 2000
MAX_PENDING_BYTES = 2**20  # of lines that could not be written yet
MAX_LINE_BYTES = 2**20  # longer lines were not written by this module
READ_BYTES = 2**20  # at a time


class EventLog:
    """A sink that appends events to `events.jsonl`.

    Events are buffered until `open` names the run folder, and while the disk is full.
    Failing to write them never ends a run.
    """

    name = EVENTS

    def __init__(self):
        self._pending = bytearray()
        self._start_time = time.monotonic()
        # For each group of subsampled events, the time of the last one that was kept
        # and the newest one that was skipped.
        self._kept_time: dict[Any, float] = {}
        self._skipped: dict[Any, Event] = {}
        self._descriptor: int | None = None
        self._path: pathlib.Path | None = None
        self._problem: OSError | None = None
        self._lost_count = 0
        self._lock = threading.RLock()

    def open(self, folder: pathlib.Path) -> None:
        """Open the file in a run folder for appending.

        Args:
          folder: The run folder, which exists. An incomplete last line that a killed
            process left there is removed.
        """
        self._path = folder / EVENTS
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_APPEND
            self._descriptor = os.open(self._path, flags, 0o666)
            _drop_incomplete_line(self._descriptor)
        except OSError as problem:
            self._problem = problem
        self._write()

    def __call__(self, event: Event) -> None:
        """Receive an event."""
        with self._lock:
            group = _subsampled_group(event)
            if group is None:
                self._append_skipped()
            else:
                now = time.monotonic()
                interval = max(
                    MIN_INTERVAL_S, INTERVAL_SHARE * (now - self._start_time)
                )
                if now - self._kept_time.get(group, -math.inf) < interval:
                    self._skipped[group] = event
                    return
                self._kept_time[group] = now
                self._skipped.pop(group, None)
            self._append(event)
            self._write()

    def _append_skipped(self):
        """Append the newest skipped event of each group, to preserve the last state."""
        for event in self._skipped.values():
            self._append(event)
        self._skipped.clear()

    def _append(self, event):
        line = json.dumps(json_values(event), allow_nan=False, default=str) + "\n"
        if len(self._pending) + len(line) > MAX_PENDING_BYTES:
            self._lost_count += 1
        else:
            self._pending += line.encode()

    def _write(self):
        if self._descriptor is None:
            return
        try:
            while self._pending:  # a write to a nearly full disk may be partial
                del self._pending[: os.write(self._descriptor, self._pending)]
            self._problem = None
        except OSError as problem:
            self._problem = problem

    def close(self) -> None:
        """Write the remaining events, and warn if any were lost."""
        with self._lock:
            self._append_skipped()
            self._write()
            if self._descriptor is not None:
                with contextlib.suppress(OSError):
                    os.close(self._descriptor)
                self._descriptor = None
            if self._path is not None and (self._problem or self._lost_count):
                reason = getattr(self._problem, "strerror", None) or "disk was full"
                console.warn(
                    f"{self._path}: some events could not be written ({reason}); "
                    "curves plotted from this file have gaps"
                )


def _subsampled_group(event):
    """Group in which an event is subsampled, or None if it is always kept."""
    if event["kind"] == "train":
        return "train"
    if event["kind"] == "stage" and event["status"] == "progress":
        return event["stage"]
    return None


def _drop_incomplete_line(descriptor):
    size = os.fstat(descriptor).st_size
    end = size
    while end:
        start = max(0, end - READ_BYTES)
        os.lseek(descriptor, start, os.SEEK_SET)
        newline = os.read(descriptor, end - start).rfind(b"\n")
        if newline >= 0:
            end = start + newline + 1
            break
        end = start
    if end < size:
        os.ftruncate(descriptor, end)


def json_values(value: Any) -> Any:
    """Replace floats that are not finite by None, since JSON cannot represent them.

    Args:
      value: Any nesting of mappings, lists, tuples and values.

    Returns:
      The same nesting of JSON values.
    """
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): json_values(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [json_values(each) for each in value]
    return value


class EventReader:
    """Reads the events of a run as they are written."""

    def __init__(self, folder: str | os.PathLike):
        self._path = pathlib.Path(folder) / EVENTS
        self._offset = 0

    def new(self) -> list[Event]:
        """Return the events that were written since the last call.

        An incomplete last line is left for the next call. Damaged lines are skipped.

        Returns:
          The events.

        Raises:
          ValueError: If the file does not exist or cannot be read.
        """
        new_events = []
        try:
            with self._path.open("rb") as file:
                if os.fstat(file.fileno()).st_size < self._offset:
                    self._offset = 0  # the file was replaced
                file.seek(self._offset)
                while line := file.readline(MAX_LINE_BYTES):
                    if not line.endswith(b"\n") and len(line) < MAX_LINE_BYTES:
                        break
                    self._offset += len(line)
                    new_events += _parse(line)
        except OSError as problem:
            raise ValueError(
                f"{self._path}: events cannot be read ({problem.strerror}); pass the "
                "folder of a run, which may still be running"
            ) from problem
        return new_events


def _parse(line):
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return []
    return [event] if isinstance(event, dict) and "kind" in event else []


def read_events(folder: str | os.PathLike) -> list[Event]:
    """Read the events of a run, which may still be running or may have been killed.

    Args:
      folder: The run folder.

    Returns:
      The events as dictionaries, in the order in which they were written.

    Raises:
      ValueError: There is no `events.jsonl` in the folder.
    """
    return EventReader(folder).new()
