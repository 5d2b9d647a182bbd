"""Files of measurements, which the same command extends until it is done."""

import json
import pathlib
from collections.abc import Mapping
from typing import Any


def rows(path: pathlib.Path, **kinds: type) -> dict[str, Any]:
    """Read the file that a command extends row by row.

    Args:
      path: The file.
      **kinds: The entries that it must have, with their types.

    Returns:
      Its content. It is empty if there is no file or a damaged one, which is reported
      and kept under another name.
    """
    return _read(path, kinds, aside=True) or {}


def one(path: pathlib.Path, kinds: Mapping[str, type]) -> dict[str, Any] | None:
    """Read the result of one part of a measurement.

    Args:
      path: The file.
      kinds: The entries that it must have, with their types.

    Returns:
      Its content, or None if there is no file or a damaged one, which is reported.
    """
    return _read(path, kinds)


def write(path: pathlib.Path, record: dict[str, Any], *machines: dict) -> None:
    """Write the file of a measurement, with the machines and revision that made it.

    Args:
      path: The file.
      record: Its content. Processors of earlier parts are kept.
      *machines: Descriptions of the machines of the parts that were added.
    """
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.metrics import clock
    from nerfies_jax.training.provenance import revision

    for machine in machines:
        record["machine"] = clock.beside(machine, record.get("machine", {}))
    record["revision"] = revision()
    write_json(path, record)


def _read(path, kinds, aside=False):
    from nerfies_jax.capture import cache_files  # loads JAX, which --help needs not

    return cache_files.read(path, lambda path: _object(path, kinds), aside)


def _object(path, kinds):
    content = json.loads(path.read_bytes())
    if not isinstance(content, dict):
        raise ValueError(f"it holds a {type(content).__name__}")
    for name, kind in kinds.items():
        if name not in content or not isinstance(content[name], kind):
            raise ValueError(f"it has no {name}")
    return content
