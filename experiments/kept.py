"""Files of finished parts of a study, so that the same command goes on."""

import json
import pathlib
from collections.abc import Mapping
from typing import Any


def rows(path: pathlib.Path, **kinds: type) -> dict[str, Any]:
    """Read the file to which a study adds row after row.

    Args:
      path: The file.
      **kinds: The entries that it must have, with their types.

    Returns:
      Its content. It is empty where there is no file or a damaged one, which is
      reported and kept under another name.
    """
    return _read(path, kinds, aside=True) or {}


def one(path: pathlib.Path, kinds: Mapping[str, type]) -> dict[str, Any] | None:
    """Read what one part of a study left.

    Args:
      path: The file.
      kinds: The entries that it must have, with their types.

    Returns:
      Its content, or None where there is no file or a damaged one, which is reported.
    """
    return _read(path, kinds)


def _read(path, kinds, aside=False):
    from nerfies_jax.capture import cache_files  # loads JAX, which --help needs not

    return cache_files.read(path, lambda path: _object(path, kinds), aside)


def _object(path, kinds):
    stored = json.loads(path.read_bytes())
    if not isinstance(stored, dict):
        raise ValueError(f"it holds a {type(stored).__name__}")
    for name, kind in kinds.items():
        if name not in stored or not isinstance(stored[name], kind):
            raise ValueError(f"it has no {name}")
    return stored
