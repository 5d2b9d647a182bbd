"""Frozen settings as text that can be stored, read and compared."""

import dataclasses
import enum
import json
from typing import Any


def describe(spec: Any) -> Any:
    """A spec as plain JSON values: dataclasses by name and fields, tuples as lists.

    Everything in a spec must be a plain value, so that two runs can be compared.
    """
    return json.loads(json.dumps(_plain(spec, "spec")))


def differences(saved: Any, wanted: Any) -> list[str]:
    """One line for each field in which two described specs differ."""
    saved, wanted = dict(_fields(saved, "spec")), dict(_fields(wanted, "spec"))
    lines = []
    for path in {**saved, **wanted}:
        before, now = saved.get(path, "absent"), wanted.get(path, "absent")
        if before != now:
            lines.append(f"{path}: saved {before}, now {now}")
    return lines


def _plain(value, path):
    if isinstance(value, enum.Enum):
        return f"{type(value).__name__}.{value.name}"
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        content = {
            field.name: _plain(getattr(value, field.name), f"{path}.{field.name}")
            for field in fields
        }
        return {"type": _name(value), **content}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        content = {k: _plain(v, f"{path}.{k}") for k, v in value._asdict().items()}
        return {"type": _name(value), **content}
    if isinstance(value, tuple | list):
        return [_plain(item, f"{path}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, frozenset) and all(isinstance(item, str) for item in value):
        return sorted(value)  # in one order, whatever the hashes of this process
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: _plain(item, f"{path}.{key}") for key, item in value.items()}
    raise ValueError(
        f"{path} holds a {type(value).__name__}, which cannot be written into a "
        "checkpoint; settings are numbers, strings, tuples and frozen dataclasses"
    )


def _name(value):
    return f"{type(value).__module__}.{type(value).__qualname__}"


def _fields(value, path):
    """Leaves by dotted path, as text: NaN must equal itself, and 1 is not 1.0."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _fields(item, f"{path}.{key}")
    elif isinstance(value, list):
        yield f"{path}.length", str(len(value))
        for index, item in enumerate(value):
            yield from _fields(item, f"{path}[{index}]")
    else:
        yield path, json.dumps(value)
