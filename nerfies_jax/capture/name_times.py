"""Frame times from the names of images."""

import collections
import datetime
import pathlib
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerfies_jax.capture import frames
from nerfies_jax.capture.text_files import forward_slashes

_NUMBER = re.compile(r"\d+\.\d+|\d+")
_CAMERA = re.compile(r"(cam|camera|view)[ _.-]?$", re.IGNORECASE)
# Cameras are synchronized if so many of the numbers of each are those of another one.
_SHARED = 0.5


class Clock(NamedTuple):
    """Frame times on any clock, of equal values for frames of equal time."""

    times: list[int] | list[float]
    cameras: np.ndarray | None  # [frames] int32 if the names tell several apart
    notes: tuple[str, ...]


def clock(names: Sequence[str]) -> Clock:
    """Read frame times from names without suffix, which may contain folders.

    The time is the first of these that applies: - the date and time at the end of the
    names, as those of phones, in ms; - the only number that differs, in seconds if it
    has a decimal point, else a count; - that number, for several cameras with the same
    numbers in otherwise different names; - the order of the names, with a note.

    Args:
      names: Names of the frames.

    Returns:
      The times, with cameras if the names tell several apart.
    """
    names = [forward_slashes(name) for name in names]
    dates = [_milliseconds(name) for name in names]
    # Read as counts, minute and hour boundaries would be gaps of 41 and 4041 frames.
    if None not in dates and not _is_counter(names, dates):
        return Clock(dates, None, ())
    fields = _time_fields(names)
    if fields is not None:
        groups, numbers = zip(*fields, strict=True)
        times = _values(groups, numbers)
        if len(set(groups)) == 1:
            return Clock(times, None, ())
        if _are_synchronized(groups, times):
            cameras = np.unique(groups, return_inverse=True)[1].astype(np.int32)
            note = (
                f"equal numbers in the names of {len(set(groups))} cameras are taken "
                "as equal times"
            )
            return Clock(times, cameras, (note,))
    note = "times are the order of the pictures' names: those end in no common count"
    return Clock(order(names), None, (note,))


def order(names: Sequence[str]) -> list[int]:
    """Return the position of each name in natural order.

    Args:
      names: Names of the frames.

    Returns:
      Positions, [frames].
    """
    rows = sorted(range(len(names)), key=lambda row: frames.natural(names[row]))
    return np.argsort(rows).tolist()


def _time_fields(names):
    """Split each name into its time and the rest, or return None if one has no number.

    The time is the last number that differs between names of one form, or the last of
    names of several forms. Numbers of cameras (cam03) are considered last.
    """
    numbers = [list(_NUMBER.finditer(name)) for name in names]
    if not all(numbers):
        return None
    forms = {_NUMBER.sub("#", name) for name in names}
    columns = range(-1, -1 - min(map(len, numbers)), -1)
    if len(forms) == 1:
        texts = {column: {row[column].group() for row in numbers} for column in columns}
        columns = [column for column in columns if len(texts[column]) > 1] or [-1]
    else:
        columns = [-1]
    chosen = next(
        (
            column
            for column in columns
            if not _CAMERA.search(names[0][: numbers[0][column].start()])
        ),
        columns[0],
    )
    fields = []
    for name, row in zip(names, numbers, strict=True):
        start, end = row[chosen].span()
        fields.append((f"{name[:start]}#{name[end:]}", row[chosen].group()))
    return fields


def _values(groups, numbers):
    """Decimal seconds, or counts where there is no point or 1.1 and 1.10 both occur."""
    if any("." in number for number in numbers):
        values = [float(number) for number in numbers]
        if len(set(zip(groups, values, strict=True))) == len(values):
            return values
    return [int(number.rpartition(".")[2]) for number in numbers]


def _are_synchronized(groups, times):
    """Test if several cameras share most of their times, and at least two."""
    members = collections.defaultdict(set)
    for group, moment in zip(groups, times, strict=True):
        members[group].add(moment)
    count = collections.Counter(
        moment for group in members.values() for moment in group
    )
    shared = {moment for moment, times in count.items() if times > 1}
    return len(shared) > 1 and all(
        len(group & shared) >= _SHARED * len(group) for group in members.values()
    )


def _milliseconds(name):
    """Milliseconds since 1970 from a name like IMG_20240131_235959, else None."""
    match = re.search(r"(?<!\d)(\d{8})[_-]?(\d{6})(\d{3})?$", name)
    if match is None:
        return None
    try:
        moment = datetime.datetime.strptime(match[1] + match[2], "%Y%m%d%H%M%S")
    except ValueError:
        return None
    since = moment - datetime.datetime(1970, 1, 1)
    return since // datetime.timedelta(milliseconds=1) + int(match[3] or 0)


def _is_counter(names, dates):
    """Test if a supposed time of day after a date is a regular count instead."""
    counts = [int(re.search(r"\d+$", pathlib.PurePath(name).name)[0]) for name in names]
    steps, gaps = set(np.diff(np.sort(counts))), set(np.diff(np.sort(dates)))
    # An interval timer is even as well, but in time.
    return len(steps) == 1 and len(gaps) > 1
