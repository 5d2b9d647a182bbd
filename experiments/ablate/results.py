"""The folder of an ablation: one pair of files for every finished arm and seed."""

import contextlib
import glob
import json
import math
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import filelock

from experiments.ablate.measures import MEASURES
from nerfies_jax.capture import cache_files
from nerfies_jax.training.provenance import provenance

# Raise the number when such files are no longer what they were.
CELL = "cell of an ablation 1"


class ArmResult(NamedTuple):
    """Stored results of one method and seed."""

    numbers: dict[str, float]
    arrays: dict[str, Any]  # color, depth, and path where points were followed
    notes: dict[str, Any]  # steps, what stopped it, points that were ever lost


def stored_numbers(numbers: Mapping[str, float]) -> dict[str, float | None]:
    """Replace numbers that are not finite by None, for JSON."""
    return {k: x if math.isfinite(x) else None for k, x in numbers.items()}


def read_numbers(stored: Mapping[str, float | None]) -> dict[str, float]:
    """From JSON: NaN for null."""
    return {k: math.nan if x is None else x for k, x in stored.items()}


def write(path: pathlib.Path, identity: dict[str, Any], kept: ArmResult) -> None:
    """Write a result and its .npz. The numbers come last and mark it as finished."""
    cache_files.write_arrays(_arrays_of(path), kept.arrays, CELL, compressed=True)
    numbers = stored_numbers(kept.numbers)
    stored = {
        "identity": identity,
        "numbers": numbers,
        "notes": kept.notes,
        "made by": provenance(),
        # A process that is killed between the two files leaves those of two runs.
        "arrays": cache_files.checksum(kept.arrays),
    }
    cache_files.write_json(path, stored, CELL)


def read(path: pathlib.Path, identity: dict[str, Any]) -> ArmResult | None:
    """A finished arm, None where there is none, or a damaged one, which is reported.

    ValueError where it was made with another identity.
    """
    kept = cache_files.read(path, _numbers_and_arrays)
    if kept is None:
        return None
    stored, arrays = kept
    if stored["identity"] != json.loads(json.dumps(identity)):  # tuples become lists
        raise ValueError(
            f"{path} was made with other settings; name another --out, or remove it to "
            "run it again"
        )
    # A measure that is younger than the file is not known there.
    numbers = {name: stored["numbers"].get(name) for name in MEASURES}
    # Of an arm that was restored its own, not that of the code that did so.
    notes = {"revision": stored["made by"]["revision"], **stored["notes"]}
    return ArmResult(read_numbers(numbers), arrays, notes)


def _arrays_of(path):
    return path.with_suffix(".npz")


def _numbers(path):
    return cache_files.read_json(path, CELL)


def _numbers_and_arrays(path):
    stored, place = _numbers(path), _arrays_of(path)
    arrays = cache_files.read_arrays(place, CELL)
    if cache_files.checksum(arrays) != stored["arrays"]:
        raise ValueError(f"{place.name} is of another run")
    return stored, arrays


def steps_of(folder: pathlib.Path, name: str) -> int | None:
    """Look up the number of steps of a method.

    Seed 0 determines it. Files of other seeds are used if that one is damaged.

    Args:
      folder: Folder of the results.
      name: Name of the method.

    Returns:
      Number of steps, None if no seed is finished.
    """
    first = folder / f"{name}-0.json"
    others = sorted(folder.glob(f"{glob.escape(name)}-[0-9]*.json"))
    for path in (first, *others):
        stored = cache_files.read(path, _numbers)
        if stored is not None and stored["identity"]["arm"] == name:
            return int(stored["identity"]["steps"])
    return None


@contextlib.contextmanager
def claimed(path: pathlib.Path) -> Iterator[bool]:
    """Lock a result for this process.

    Args:
      path: The result.

    Yields:
      Whether this process holds the lock. It is released with the block or the process.
    """
    name = path.with_name(f".{path.stem}.lock")
    lock = filelock.FileLock(name)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        yield False
        return
    try:
        yield True
    finally:
        with contextlib.suppress(OSError):  # Windows removes no file that is open
            name.unlink()
        lock.release()
