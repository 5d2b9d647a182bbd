"""The folder of an ablation: one pair of files for every finished arm and seed."""

import contextlib
import json
import math
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import filelock
import numpy as np

from experiments.ablate.measures import MEASURES
from nerfies_jax.capture import npz_files
from nerfies_jax.capture.json_files import replaced_file, write_json
from nerfies_jax.training.provenance import provenance

STEPS = "steps.json"  # of arms that need not find out what their seconds are worth
# Fields of specs that came after arms were kept: none, they change nothing in these.
YOUNGER = ("poses",)


class ArmResult(NamedTuple):
    """What is left of one arm and seed when it is finished."""

    numbers: dict[str, float]
    arrays: dict[str, Any]  # colour, depth, and path where points were followed
    notes: dict[str, Any]  # steps, what stopped it, points that were ever lost


def stored_numbers(numbers: Mapping[str, float]) -> dict[str, float | None]:
    """As JSON has them: null for what is not finite."""
    return {k: x if math.isfinite(x) else None for k, x in numbers.items()}


def read_numbers(stored: Mapping[str, float | None]) -> dict[str, float]:
    """From JSON: NaN for null."""
    return {k: math.nan if x is None else x for k, x in stored.items()}


def write(path: pathlib.Path, identity: dict[str, Any], kept: ArmResult) -> None:
    """`path` and its .npz; numbers last: an arm is finished when they are there."""
    with replaced_file(path.with_suffix(".npz")) as partial:
        np.savez_compressed(partial, **kept.arrays)
    numbers = stored_numbers(kept.numbers)
    write_json(
        path,
        {
            "identity": identity,
            "numbers": numbers,
            "notes": kept.notes,
            "made by": provenance(),
        },
    )


def read(path: pathlib.Path, identity: dict[str, Any]) -> ArmResult | None:
    """A finished arm, None where there is none.

    ValueError where it cannot be read, or was made with another identity.
    """
    if not path.is_file():
        return None
    try:
        stored = json.loads(path.read_text())
        # A measure that is younger than the file is not known there.
        numbers = {name: stored["numbers"].get(name) for name in MEASURES}
        arrays = npz_files.read_arrays(path.with_suffix(".npz"))
        made_with = stored["identity"]
        # Of an arm that was restored its own, not that of the code that did so.
        revision = stored.get("made by", {}).get("revision", "unknown")
        notes = {"revision": revision, **stored["notes"]}
    except (KeyError, TypeError, ValueError, OSError) as error:
        raise ValueError(
            f"{path}: not a finished arm ({error}); remove it to run it again"
        ) from error
    if made_with != json.loads(json.dumps(identity)):  # tuples come back as lists
        raise ValueError(
            f"{path} was made with other settings; name another --out, or remove it to "
            "run it again"
        )
    return ArmResult(read_numbers(numbers), arrays, notes)


def steps_of(path: pathlib.Path) -> int | None:
    """Over how many steps a finished arm was to be trained; None where none is."""
    try:
        return int(json.loads(path.read_text())["identity"]["steps"])
    except FileNotFoundError:
        return None
    except (KeyError, TypeError, ValueError, OSError) as error:
        raise ValueError(
            f"{path}: not a finished arm ({error}); remove it to run it again"
        ) from error


def settle_steps(folder: pathlib.Path, steps: dict[str, int]) -> None:
    """Keep over how many steps some arms of this folder are to be trained."""
    write_json(folder / STEPS, settled_steps(folder) | steps)


def settled_steps(folder: pathlib.Path) -> dict[str, int]:
    """What `settle_steps` kept, by arm; of all others the first seed finds them."""
    path = folder / STEPS
    return json.loads(path.read_text()) if path.is_file() else {}


@contextlib.contextmanager
def claimed(path: pathlib.Path) -> Iterator[bool]:
    """Whether this process may make `path`; false while another one does.

    The claim ends with the block, or with the process, however that ends.
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


def without_younger(stored: dict[str, Any]) -> dict[str, Any]:
    """A spec as JSON, as it was before there was a choice that it leaves out."""
    absent = [name for name in YOUNGER if stored.get(name, "") is None]
    return {name: item for name, item in stored.items() if name not in absent}
