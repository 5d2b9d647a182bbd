"""Keys of JSON files that no reader knows, which may change the scene."""

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
      known: Its keys that are read, or that change nothing. None for any.
      inner: The same of the objects in lists or objects under some keys; under the key
        None of those at the top level.

    Returns:
      A note, or none.
    """
    table = read_json(file, dict[str, Any])
    keys = set() if known is None else set(table) - set(known)
    for key, inside in inner.items():
        entries = table if key is None else table.get(key, ())
        entries = entries.values() if isinstance(entries, dict) else entries
        for entry in entries:
            keys |= set(entry) - set(inside)
    if not keys:
        return ()
    return (f"keys of {file.name} that are not read: {', '.join(sorted(keys))}",)
