"""Frame times from a separate file, for captures without correct times."""

import collections
import dataclasses
import datetime
import pathlib
import re
from collections.abc import Callable

import numpy as np

from nerfies_jax.capture import frames, safe_files, splits, text_files
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.json_files import AnyPath, read_json

MAX_BYTES = 64 * 2**20
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")  # float() takes 0_1
_DATE = re.compile(r"(\d{4}-\d\d-\d\d) (?=\d\d:\d\d)")  # of ISO 8601, with a space
_LAST_NUMBER = re.compile(r"\d+(?=\D*$)")


def with_times(capture: Capture, path: AnyPath) -> Capture:
    """Replace the times of a capture by those of a file.

    If the capture has only one camera but several frames of equal time, and their names
    without the last number differ, those names identify the cameras.

    Args:
      capture: The capture.
      path: JSON, an object of frame names and times or a list of times; or text with
        one frame in each line, name and time separated by a comma, semicolon or space,
        or the time alone. Times are numbers on any clock, such as seconds, or dates
        of ISO 8601 with a time of day. Without names there is one for each frame, in
        the natural order of their names. A line without a number at its end before all
        others is a heading.

    Returns:
      The capture, with times from 0 to 1 and `warp_ids` by them.

    Raises:
      CaptureError: The file cannot be read, or a frame has no time in it.
    """
    path = pathlib.Path(path)
    by_name, ordered_times = _read(path)
    names = sorted(capture.ids, key=frames.natural)
    notes: tuple[str, ...] = ()
    if ordered_times is not None:
        if len(ordered_times) != len(names):
            raise CaptureError(
                f"{path}: {len(ordered_times)} times for {len(names)} frames; write "
                "one for each, in the order of their names, or add the names"
            )
        table = dict(zip(names, ordered_times, strict=True))
        values = [table[name] for name in capture.ids]
    else:
        values, notes = _by_name(capture, by_name, path)
    clock = np.array(values, np.float64)
    if not np.isfinite(clock).all():
        row = int(np.argmin(np.isfinite(clock)))
        raise CaptureError(
            f"{path}: frame {capture.ids[row]!r} has time {clock[row]:g}; every time "
            "must be a finite number"
        )
    camera_ids, camera_notes = _cameras(capture, clock)
    first, last = clock.min(), clock.max()
    note = f"times from {path.name}: {first:.6g} to {last:.6g} are mapped to 0 to 1"
    is_regrouped = not np.array_equal(camera_ids, capture.camera_ids)
    return dataclasses.replace(
        capture,
        times=splits.spread(clock),
        warp_ids=splits.dense(clock),
        camera_ids=camera_ids,
        # Flow is between frames of one camera.
        flow=None if is_regrouped else capture.flow,
        notes=(*capture.notes, note, *notes, *camera_notes),
    )


def _read(path):
    """Times by name, or a list of times."""
    if path.suffix.lower() == ".json":
        content = read_json(path, dict[str, float | str] | list[float | str])
        if isinstance(content, dict):
            return {name: _value(time, path) for name, time in content.items()}, None
        return None, [_value(time, path) for time in content]
    try:
        text = text_files.utf8(safe_files.read_bytes(path, MAX_BYTES)).decode()
    except UnicodeDecodeError as error:
        raise CaptureError(
            f"{path}: not text ({error.reason}); save it as UTF-8"
        ) from None
    lines = [line.strip() for line in text.splitlines()]
    rows = [
        [
            part.strip("\"'")
            for part in re.split(r"[,;\t]\s*|\s+(?=\S+$)", _DATE.sub(r"\1T", line))
        ]
        for line in lines
        if line and not line.startswith("#")
    ]
    if rows and _number(rows[0][-1]) is None and _number(rows[0][0]) is None:
        rows = rows[1:]  # a heading
    if not rows:
        raise CaptureError(f"{path}: no times; write a name and a time per line")
    widths = collections.Counter(map(len, rows))
    width = widths.most_common(1)[0][0]
    time_first = any(_number(row[-1]) is None for row in rows) and all(
        _number(row[0]) is not None for row in rows
    )
    for row in rows:
        value = _number(row[0] if time_first else row[-1])
        if len(row) != width or width > 2 or value is None:
            raise CaptureError(
                f"{path}: {' '.join(row)!r} is not a frame's name and time; write both "
                "in each line, or the time alone in all, as a number or an ISO 8601 "
                "date"
            )
    if width == 1:
        return None, [_value(row[0], path) for row in rows]
    pairs = [tuple(reversed(row)) if time_first else tuple(row) for row in rows]
    by_name: dict[str, float] = {}
    for name, number in pairs:
        time = _value(number, path)
        if by_name.setdefault(name, time) != time:
            raise CaptureError(f"{path}: frame {name!r} has two times; keep one")
    return by_name, None


def _number(word):
    """A time as a number, seconds since 1970 of a date, or None if it is neither."""
    if _NUMBER.fullmatch(word):
        return float(word)
    try:
        date = datetime.datetime.fromisoformat(word)
    except ValueError:
        return None
    if date.tzinfo is None:
        date = date.replace(tzinfo=datetime.UTC)
    return date.timestamp()


def _value(time, path):
    """The number of a time from a file, which may be text."""
    value = _number(time) if isinstance(time, str) else time
    if value is None:
        raise CaptureError(
            f"{path}: {time!r} is not a time; write a number or an ISO 8601 date"
        )
    return value


def _by_name(capture, times, path):
    """The time of each frame, and a note on entries without a frame."""
    table = {_plain(name): number for name, number in times.items()}
    if len(table) < len(times):
        raise CaptureError(f"{path}: several names of one frame; keep one of each")
    find = _finder(table)
    keys = [find(name) for name in capture.ids]
    absent = [name for name, key in zip(capture.ids, keys, strict=True) if key is None]
    if absent:
        listing = ", ".join(absent[:5]) + (", ..." if len(absent) > 5 else "")
        raise CaptureError(
            f"{path}: no time for {len(absent)} of {len(keys)} frames ({listing}); add "
            "them under these names, or under those of their images"
        )
    unused_count = len(table) - len({*keys})
    notes = (
        (f"{unused_count} entries of {path.name} have no frame",)
        if unused_count
        else ()
    )
    return [table[key] for key in keys], notes


def _plain(name):
    """The frame id of an image path: folders joined by underscores, without suffix."""
    stem = pathlib.PurePosixPath(text_files.forward_slashes(name))
    if stem.suffix.lower() in (*frames.SUFFIXES, ".exr"):
        stem = stem.with_suffix("")
    return "_".join(part for part in stem.parts if part not in (".", "/"))


def _finder(table) -> Callable[[str], str | None]:
    """Make a function that finds the entry of a frame id.

    Either of the two names may have additional folders in front.
    """
    ends = collections.defaultdict(list)
    for key in table:
        parts = key.split("_")
        for first in range(1, len(parts)):
            ends["_".join(parts[first:])].append(key)

    def find(name):
        if name in table:
            return name
        parts = name.split("_")
        shorter = ["_".join(parts[first:]) for first in range(1, len(parts))]
        matches = [*ends.get(name, ()), *(each for each in shorter if each in table)]
        unique = len(matches) == 1 or (matches and matches[0] in shorter)
        return matches[0] if unique else None

    return find


def _cameras(capture, clock):
    """Camera ids, derived from the names if frames share times, and a note."""
    pairs = {*zip(clock.tolist(), capture.camera_ids.tolist(), strict=True)}
    if len(pairs) == len(clock) or capture.camera_ids.any():
        return capture.camera_ids, ()
    groups = [_LAST_NUMBER.sub("#", name) for name in capture.ids]
    if len({*zip(clock.tolist(), groups, strict=True)}) < len(clock):
        return capture.camera_ids, ()
    count = len({*groups})
    note = f"frames share times: taken as {count} cameras, identified by their names"
    return splits.dense(groups), (note,)
