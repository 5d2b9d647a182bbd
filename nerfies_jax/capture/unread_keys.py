"""Detection of unknown keys in JSON files, which may affect the scene."""

import pathlib
from collections.abc import Collection, Mapping
from typing import Any

from nerfies_jax.capture.json_files import read_json


def notes(
    file: pathlib.Path,
    known: Collection[str] | None,
    inner: Mapping[str | None, Collection[str]] = {},
) -> tuple[str, ...]:
    """Name the keys of a file that are not read.

    Args:
      file: A file whose top level is an object.
      known: Known keys of the top level. None to accept any.
      inner: Known keys of the entries of a list or object, by its key. The key None
        stands for the top level itself.

    Returns:
      A note, or an empty tuple if all keys are known.
    """
    table = read_json(file, dict[str, Any])
    keys = set() if known is None else set(table) - set(known)
    for key, known_inner in inner.items():
        entries = table if key is None else table.get(key, ())
        entries = entries.values() if isinstance(entries, dict) else entries
        for entry in entries:
            keys |= set(entry) - set(known_inner)
    if not keys:
        return ()
    return (f"keys of {file.name} that are not read: {', '.join(sorted(keys))}",)
