"""Frame times from the names of images."""

import collections
import datetime
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerfies_jax.capture import frames
from nerfies_jax.capture.text_files import forward_slashes

_NUMBER = re.compile(r"\d+[.,]\d+|\d+")
_CAMERA = re.compile(r"(cam|camera|view)[ _.-]?$", re.IGNORECASE)
# A date and a time of day at the end of a name, with any separators or none.
_DATE = re.compile(
    r"(?<!\d)(\d{4})([-_.]?)(\d\d)\2(\d\d)(?:T| at |[ _-]{0,2})"
    r"(\d\d)([-_.:]?)(\d\d)\6(\d\d)(?:[.,](\d{1,9})|[_-]?(\d{3}|\d{6}|\d{9}))?Z?$"
)
LEAST_DIGITS = 9  # smallest number of digits of an integer timestamp
# Cameras are synchronized if at least this share of the numbers of each camera also
# occurs for another one.
_SHARED = 0.5


class Clock(NamedTuple):
    """Frame times on any clock."""

    times: list[int] | list[float]
    cameras: np.ndarray | None  # [frames] int32 if the names tell several apart
    notes: tuple[str, ...]


def clock(names: Sequence[str]) -> Clock:
    """Read frame times from names without suffix, which may contain folders.

    The time is the first of these that applies:

    - the date and time at the end of the names, as those of phones, in microseconds;
    - the only number that differs, in seconds if it has a decimal point or comma, else
      a count;
    - that number, for several cameras with the same numbers in otherwise different
      names, or with timestamps of one clock;
    - the order of the names, with a note.

    Args:
      names: Names of the frames.

    Returns:
      The times, with cameras if the names tell several apart.
    """
    names = [forward_slashes(name) for name in names]
    dates = [_microseconds(name) for name in names]
    # Dates read as counts would have gaps of 41 and 4041 at minute and hour boundaries.
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
        if all(map(_is_timestamp, numbers)):
            if len(set(groups)) == len(groups):  # another number counts the frames
                return Clock(times, None, ())
            if _overlap(groups, times):
                cameras = np.unique(groups, return_inverse=True)[1].astype(np.int32)
                note = (
                    f"the numbers in the names of {len(set(groups))} cameras are taken "
                    "as times of one clock"
                )
                return Clock(times, cameras, (note,))
    note = "times are the order of the image names, which have no common number"
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
    """Split each name into its time and the remainder. None if a name has no number.

    The time is the last number that differs between names of one form, or the last
    number of names of several forms. Camera numbers (cam03) are considered last.
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
    field = next(
        (
            column
            for column in columns
            if not _CAMERA.search(names[0][: numbers[0][column].start()])
        ),
        columns[0],
    )
    fields = []
    for name, row in zip(names, numbers, strict=True):
        start, end = row[field].span()
        fields.append((f"{name[:start]}#{name[end:]}", row[field].group()))
    return fields


def _values(groups, numbers):
    """Decimal seconds, or counts if there is no point or both 1.1 and 1.10 occur."""
    numbers = [number.replace(",", ".") for number in numbers]
    if any("." in number for number in numbers):
        values = [float(number) for number in numbers]
        if len(set(zip(groups, values, strict=True))) == len(values):
            return values
    return [int(number.rpartition(".")[2]) for number in numbers]


def _are_synchronized(groups, times):
    """Test if several cameras share most of their times, and at least two."""
    members = collections.defaultdict(set)
    for group, time in zip(groups, times, strict=True):
        members[group].add(time)
    counts = collections.Counter(time for group in members.values() for time in group)
    shared_times = {time for time, count in counts.items() if count > 1}
    return len(shared_times) > 1 and all(
        len(group & shared_times) >= _SHARED * len(group) for group in members.values()
    )


def _is_timestamp(number):
    return not number.isdecimal() or len(number) >= LEAST_DIGITS


def _overlap(groups, times):
    """Test if each camera has frames while another one has."""
    spans = collections.defaultdict(list)
    for group, time in zip(groups, times, strict=True):
        spans[group].append(time)
    spans = {group: (min(span), max(span)) for group, span in spans.items()}
    # In the order of start times, a camera overlaps an earlier one or none.
    last = None
    alone = set(spans)
    for group, (first, end) in sorted(spans.items(), key=lambda item: item[1]):
        if last is not None and first <= spans[last][1]:
            alone -= {group, last}
        if last is None or end > spans[last][1]:
            last = group
    return not alone


def _microseconds(name):
    """Microseconds since 1970 from a name like IMG_20240131_235959, else None."""
    match = _DATE.search(name)
    if match is None:
        return None
    year, _, month, day, hour, _, minute, second, fraction, digits = match.groups()
    try:
        date = datetime.datetime(
            *map(int, (year, month, day, hour, minute, second)), tzinfo=datetime.UTC
        )
    except ValueError:
        return None
    since_epoch = date - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    part = (fraction or digits or "0")[:6].ljust(6, "0")
    return since_epoch // datetime.timedelta(microseconds=1) + int(part)


def _is_counter(names, dates):
    """Test if the supposed time of day after a date is a regular count instead."""
    ends = [re.search(r"\d{6,}$", name) for name in names]
    if None in ends:  # a time of day with separators
        return False
    counts = [int(end[0]) for end in ends]
    steps, gaps = set(np.diff(np.sort(counts))), set(np.diff(np.sort(dates)))
    # Images of an interval timer are evenly spaced in time instead.
    return len(steps) == 1 and len(gaps) > 1
