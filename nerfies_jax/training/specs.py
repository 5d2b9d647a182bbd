"""Frozen settings ("specs") as plain JSON: conversion, overrides and comparison.

This codec is used for checkpoints, run folders, model files and results of studies.
Nothing in a file is executed or imported. The names in a file only select among the
types that the reader expects.
"""

import contextlib
import dataclasses
import difflib
import importlib
import json
import math
import pathlib
import typing
from collections.abc import Iterable, Iterator
from typing import Any

from nerfies_jax.capture.nearest import known_names
from nerfies_jax.training import extensions, spec_fields

TYPE = "type"  # JSON key of the type of a spec; no field can have this name
NUMBER = "number"  # JSON key of an infinity or NaN, which JSON does not have
PACKAGES = ("gaussians_jax", "nerfies_jax")  # packages of types that files may name


class OverrideError(ValueError):
    """An assignment names an unknown field of a spec, or an invalid value."""


# JSON -------------------------------------------------------------------------------


def as_json(value: Any) -> Any:
    """Convert a spec to plain JSON values, with the type of each record.

    `from_json` converts it back, with tuples in place of lists and sets.

    Args:
      value: A spec, or any nesting of specs, containers and numbers.

    Returns:
      JSON values.

    Raises:
      ValueError: If a value cannot be part of a spec, with its path.
    """
    return _plain(value, "spec")


def _plain(value, path):
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {NUMBER: str(value)}
    if isinstance(value, pathlib.Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {
            field.name: getattr(value, field.name)
            for field in dataclasses.fields(value)
        }
        return {TYPE: type_name(type(value)), **_items(fields, path)}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {TYPE: type_name(type(value)), **_items(value._asdict(), path)}
    if isinstance(value, tuple | list):
        return [_plain(item, f"{path}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, frozenset) and all(isinstance(item, str) for item in value):
        return sorted(value)  # because the order of a set depends on the process
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return _items(value, path)
    raise ValueError(
        f"{path} is a {type(value).__name__}, which cannot be stored; settings are "
        "numbers, strings, tuples and frozen dataclasses"
    )


def _items(content, path):
    return {key: _plain(item, f"{path}.{key}") for key, item in content.items()}


def from_json(document: Any, *kinds: type) -> Any:
    """Read the value that `as_json` wrote.

    Args:
      document: JSON values.
      *kinds: Outermost types that are allowed. The types of their annotated fields are
        allowed too, and no others.

    Returns:
      The value. Lists come back as tuples.

    Raises:
      ValueError: If a type is not allowed, or a field is unknown, missing or out of
        range. Nothing is imported to check this.
    """
    return _revive(document, allowed_names(*kinds))


def allowed_names(*kinds: type) -> dict[str, type]:
    """Return types of settings and those of their fields, by name.

    Args:
      *kinds: Types of settings.

    Returns:
      These types and, recursively, the types of their annotated fields.
    """
    return {type_name(kind): kind for kind in _collect_records(kinds)}


def _revive(node, kinds):
    if isinstance(node, list):
        return tuple(_revive(item, kinds) for item in node)
    if not isinstance(node, dict):
        return node
    if node.keys() == {NUMBER}:
        return float(node[NUMBER])
    fields = {key: _revive(item, kinds) for key, item in node.items()}
    if TYPE not in node:
        return fields
    name = fields.pop(TYPE)
    if not isinstance(name, str) or name not in kinds:
        raise ValueError(
            f"it names {name!r}, which is no record or setting of this version that "
            "may be here"
        )
    return build_record(kinds[name], fields)


def _collect_records(kinds):
    """Collect the records among `kinds` and, recursively, in their fields."""
    records, pending = set(), [*kinds]
    while pending:
        kind = pending.pop()
        pending += typing.get_args(kind)
        if _is_record(kind) and kind not in records:
            records.add(kind)
            pending += typing.get_type_hints(kind).values()
    return records


def _is_record(kind):
    return isinstance(kind, type) and (
        dataclasses.is_dataclass(kind)
        or (issubclass(kind, tuple) and hasattr(kind, "_fields"))
    )


def build_record(kind: type[Any], fields: dict[str, Any]) -> Any:
    """Build a dataclass or NamedTuple from its fields.

    Args:
      kind: The type.
      fields: All of its fields by name.

    Returns:
      An instance of `kind`.

    Raises:
      ValueError: If the fields are not those of this version.
    """
    if dataclasses.is_dataclass(kind):
        names = {field.name for field in dataclasses.fields(kind)}
    else:
        names = {*kind._fields}
    if fields.keys() != names:
        raise ValueError(
            f"a stored {kind.__name__} with {', '.join(sorted(fields))} is none of "
            f"this version, which has {', '.join(sorted(names))}; open it with the "
            "version that made it"
        )
    return kind(**fields)


def type_name(kind: type) -> str:
    """Return the full name of a type, as stored in files.

    Args:
      kind: The type.

    Returns:
      Module and qualified name, joined by a dot, or by a colon if the type is from
      another package.
    """
    ours = kind.__module__.partition(".")[0] in (*PACKAGES, "experiments")
    separator = "." if ours else extensions.SEPARATOR
    return f"{kind.__module__}{separator}{kind.__qualname__}"


def record_named(name: Any) -> type:
    """Find a NamedTuple of arrays of these packages by its full name.

    Only public modules of `PACKAGES` are imported, and only a NamedTuple that is
    defined in such a module is returned, so that a file cannot choose code to run.

    Args:
      name: Full name, as `type_name` gives it.

    Returns:
      The type.

    Raises:
      ValueError: If there is no such type.
    """
    module, _, attribute = str(name).rpartition(".")
    top, *parts = module.split(".")
    kind: Any = None
    if top in PACKAGES and all(x.isidentifier() and x[0] != "_" for x in parts):
        with contextlib.suppress(ImportError):
            kind = getattr(importlib.import_module(module), attribute, None)
    is_tuple = _is_record(kind) and issubclass(kind, tuple)
    if not is_tuple or type_name(kind) != name:
        raise ValueError(
            f"it names {name!r}, which is no record or setting of this version of "
            f"{' and '.join(PACKAGES)}"
        )
    return kind


# Comparing --------------------------------------------------------------------------


def differences(previous: Any, current: Any) -> list[str]:
    """Compare two specs.

    Args:
      previous: First spec, as JSON.
      current: Second spec, as JSON.

    Returns:
      One line for each field in which they differ.
    """
    previous, current = dict(_leaves(previous, "spec")), dict(_leaves(current, "spec"))
    lines = []
    for path in {**previous, **current}:
        before, now = previous.get(path, "absent"), current.get(path, "absent")
        if before != now:
            lines.append(f"{path}: saved {before}, now {now}")
    return lines


def _leaves(value, path) -> Iterator[tuple[str, str]]:
    """Yield the leaves by dotted path, as text, so that 1 and 1.0 differ."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves(item, f"{path}.{key}")
    elif isinstance(value, list):
        yield f"{path}.length", str(len(value))
        for index, item in enumerate(value):
            yield from _leaves(item, f"{path}[{index}]")
    else:
        yield path, json.dumps(value)


# Changing ---------------------------------------------------------------------------


def override(spec: Any, assignments: Iterable[str]) -> Any:
    """Apply `path.to.field=value` assignments to a spec.

    Fields of a nested spec are set by a dotted path, which creates the nested spec with
    its defaults if it is None. The value `none` removes it, if its type allows that. A
    class name, as in `config.json`, selects one of several types of nested specs.
    Settings are validated once, with all assignments, in whatever order they come.

    Args:
      spec: A frozen dataclass.
      assignments: Texts of the form `path.to.field=value`. The value is parsed by the
        type of the field.

    Returns:
      The changed spec.

    Raises:
      OverrideError: If a field is unknown, a value cannot be parsed, or the settings
        with all assignments are invalid.
    """
    draft = _Draft(spec)
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        if not equals:
            raise OverrideError(f"{assignment}: expected path.to.field=value")
        draft.assign(path.split("."), text, path, spec)
    return draft.build()


class _Draft:
    """A spec with assignments to its fields, which are validated together at the end.

    Two settings can be valid together although one of them with the former value of the
    other is not.
    """

    def __init__(self, spec: Any) -> None:
        self.spec = spec
        self.changes: dict[str, Any] = {}  # values, and drafts of nested specs
        self.assignments: list[str] = []

    def assign(self, names: list[str], text: str, path: str, outermost: Any) -> None:
        """Set the field `names` of this spec, or of a spec in it, to a parsed text."""
        spec, (name, *inner_names) = self.spec, names
        fields = {field.name for field in dataclasses.fields(spec)}
        if name not in fields:
            raise OverrideError(
                f"{path}: {type(spec).__name__} has no field {name!r}; "
                + _suggestion(names[-1], sorted(fields), outermost)
            )
        self.assignments.append(f"{path}={text}")
        if not inner_names:
            kind = typing.get_type_hints(type(spec))[name]
            self.changes[name] = _read(kind, text, path)
            return
        inner = self.changes.get(name, getattr(spec, name))
        if inner is None:
            inner = _default_of_absent(spec, name)
        if not isinstance(inner, _Draft):
            if not dataclasses.is_dataclass(inner):
                raise OverrideError(f"{path}: {name!r} is {inner!r} and has no fields")
            inner = self.changes[name] = _Draft(inner)
        inner.assign(inner_names, text, path, outermost)

    def build(self) -> Any:
        """Return the spec, or raise an error that names the assignments to it."""
        changes = {
            name: value.build() if isinstance(value, _Draft) else value
            for name, value in self.changes.items()
        }
        try:
            return dataclasses.replace(self.spec, **changes)
        except ValueError as error:
            raise OverrideError(f"{' '.join(self.assignments)}: {error}") from error


def _suggestion(name, fields, outermost):
    """List the known fields, and the path of a similar field elsewhere."""
    paths = [field.path for field in spec_fields.fields_of(outermost)]
    last = [path.rpartition(".")[2] for path in paths]
    similar = difflib.get_close_matches(name, [*fields, *last], n=1)
    if not similar or similar[0] in fields:
        return known_names(name, fields)
    matches = [path for path, end in zip(paths, last, strict=True) if end == similar[0]]
    return f"did you mean {' or '.join(matches)}? its fields are {', '.join(fields)}"


def _default_of_absent(spec, name):
    """Return the default settings of an absent component, if its type is unique."""
    options = typing.get_args(typing.get_type_hints(type(spec))[name])
    choices = [option for option in options if dataclasses.is_dataclass(option)]
    return _defaults(choices[0], name) if len(choices) == 1 else None


def _read(kind, text, path):
    options = typing.get_args(kind)
    choices = [option for option in options if dataclasses.is_dataclass(option)]
    classes = {choice.__name__: choice for choice in choices}
    if text in classes:
        return _defaults(classes[text], path)
    origin = typing.get_origin(kind)
    item_types = typing.get_args(options[0]) if origin is tuple else ()
    protocols = _protocols(item_types or options)
    if protocols and item_types:
        names = [part for part in text.split(",") if part]
        return tuple(_load(name, protocols, path) for name in names)
    if protocols and extensions.SEPARATOR in text:
        return _load(text, protocols, path)
    if type(None) in options:
        if text.lower() == "none":
            return None
        kind = next(option for option in options if option is not type(None))
    if origin is not tuple:
        kind = next((x for x in options if x in {int, float, str}), kind)
    if kind is bool and text.lower() in {"true", "false"}:
        return text.lower() == "true"
    try:
        if kind in {int, float, str}:
            return kind(text)
        if origin is typing.Literal and text in typing.get_args(kind):
            return text
        if origin is tuple:
            item = typing.get_args(kind)[0]
            return tuple(item(part) for part in text.split(",") if part)
    except ValueError:
        pass
    if classes:
        kind = f"one of {', '.join([*classes, *['MODULE:NAME'] * bool(protocols)])}"
    raise OverrideError(f"{path}={text}: cannot be read as {kind}")


def _protocols(options):
    """Select the protocols among the types of a field."""
    return [kind for kind in options if getattr(kind, "_is_protocol", False)]


def _load(name, protocols, path):
    """Load a component by name and check it against the first of the protocols."""
    try:
        component = extensions.load(name)
        extensions.check(path, component, protocols[0])
    except ValueError as error:
        raise OverrideError(f"{path}={name}: {error}") from error
    return component


def _defaults(spec_class, path):
    """Make a spec with the defaults of all its fields."""
    required_names = [
        field.name
        for field in dataclasses.fields(spec_class)
        if field.default is field.default_factory is dataclasses.MISSING
    ]
    if required_names:
        raise OverrideError(
            f"{path}: {spec_class.__name__} has no defaults for "
            f"{' and '.join(required_names)}; choose a preset that has it"
        )
    return spec_class()
