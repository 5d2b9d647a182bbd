"""Writer and reader of `events.jsonl`, the event stream in a run folder.

It has one JSON object per line. A run that is resumed appends to it. It can be read
while the run goes on. docs/events.md lists the kinds of events and their fields.
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
TRAIN_SECONDS = 0.5  # between two rows of training, and of the progress of a stage
# And at least this share of the time since the log began: a day has some 17,000 rows of
# training, not 170,000.
TRAIN_SHARE = 1 / 2000
MOST_WAITING_BYTES = 2**20  # of lines that the disk did not take yet
LONGEST_LINE = 2**20  # bytes; a longer one is none of ours
READ_BYTES = 2**20  # at a time


class EventLog:
    """A sink that appends events to `events.jsonl`.

    Events that come before the run folder is known wait until `open` names it. A disk
    that is full keeps later events waiting, and ends nothing: they are written as soon
    as there is room again.
    """

    name = EVENTS

    def __init__(self):
        self._waiting = bytearray()
        self._began = time.monotonic()
        self._written: dict[Any, float] = {}  # when, by what is thinned out
        self._thinned: dict[Any, Event] = {}  # the newest that was left out
        self._descriptor: int | None = None
        self._path: pathlib.Path | None = None
        self._problem: OSError | None = None
        self._lost = 0  # events
        self._lock = threading.RLock()

    def open(self, folder: pathlib.Path) -> None:
        """Open the file in a run folder for appending.

        Args:
          folder: The run folder, which exists. An incomplete last line of a killed
            process is removed.
        """
        self._path = folder / EVENTS
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_APPEND
            self._descriptor = os.open(self._path, flags, 0o666)
            _drop_torn_line(self._descriptor)
        except OSError as problem:
            self._problem = problem
        self._write()

    def __call__(self, event: Event) -> None:
        """Receive an event."""
        with self._lock:
            key = _thinned_by(event)
            if key is not None:
                now = time.monotonic()
                wait = max(TRAIN_SECONDS, TRAIN_SHARE * (now - self._began))
                if now - self._written.get(key, -math.inf) < wait:
                    self._thinned[key] = event
                    return
                self._written[key] = now
                self._thinned.pop(key, None)
            else:
                # In order, and with the last of what was thinned out before it.
                for each in self._thinned.values():
                    self._append(each)
                self._thinned.clear()
            self._append(event)
            self._write()

    def _append(self, event):
        line = json.dumps(json_values(event), allow_nan=False, default=str) + "\n"
        if len(self._waiting) + len(line) > MOST_WAITING_BYTES:
            self._lost += 1
        else:
            self._waiting += line.encode()

    def _write(self):
        if self._descriptor is None:
            return
        try:
            while self._waiting:  # a disk that fills up takes a part of a line
                del self._waiting[: os.write(self._descriptor, self._waiting)]
            self._problem = None
        except OSError as problem:
            self._problem = problem

    def close(self) -> None:
        """Write the remaining events, and warn if any were lost."""
        with self._lock:
            for each in self._thinned.values():
                self._append(each)
            self._thinned.clear()
            self._write()
            if self._descriptor is not None:
                with contextlib.suppress(OSError):
                    os.close(self._descriptor)
                self._descriptor = None
            if self._path is not None and (self._problem or self._lost):
                reason = getattr(self._problem, "strerror", None) or "no space in time"
                console.warn(
                    f"{self._path}: not all events of the run are in it ({reason}); "
                    "curves that are drawn from it have gaps"
                )


def _thinned_by(event):
    """Group of events that is thinned out, or None for events that are all kept."""
    if event["kind"] == "train":
        return "train"
    if event["kind"] == "stage" and event["status"] == "progress":
        return event["stage"]
    return None


def _drop_torn_line(descriptor):
    size = os.fstat(descriptor).st_size
    end = size
    while end:
        begin = max(0, end - READ_BYTES)
        os.lseek(descriptor, begin, os.SEEK_SET)
        newline = os.read(descriptor, end - begin).rfind(b"\n")
        if newline >= 0:
            end = begin + newline + 1
            break
        end = begin
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

        A line that is not complete yet is left for the next call, and a damaged one is
        skipped.

        Returns:
          The events.

        Raises:
          ValueError: If the file does not exist or cannot be read.
        """
        received = []
        try:
            with self._path.open("rb") as file:
                if os.fstat(file.fileno()).st_size < self._offset:
                    self._offset = 0  # it was replaced
                file.seek(self._offset)
                while line := file.readline(LONGEST_LINE):
                    if not line.endswith(b"\n") and len(line) < LONGEST_LINE:
                        break
                    self._offset += len(line)
                    received += _parsed(line)
        except OSError as problem:
            raise ValueError(
                f"{self._path}: no events can be read ({problem.strerror}); name the "
                "folder of a run, one that is still running as well"
            ) from problem
        return received


def _parsed(line):
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return []
    return [event] if isinstance(event, dict) and "kind" in event else []


def read_events(folder: str | os.PathLike) -> list[Event]:
    """Read the events of a run, also of one that is running or was killed.

    Args:
      folder: The run folder.

    Returns:
      The events as dictionaries, in the order in which they were written.

    Raises:
      ValueError: There is no `events.jsonl` in the folder.
    """
    return EventReader(folder).new()
