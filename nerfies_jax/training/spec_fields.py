"""Listing of the fields of a spec: path, value, default, type and description."""

import ast
import dataclasses
import functools
import inspect
import io
import itertools
import re
import textwrap
import tokenize
import typing
from collections.abc import Iterator
from typing import Any, NamedTuple


class SpecField(NamedTuple):
    """One field of a spec, or of a spec nested in it."""

    path: str  # dotted path from the outermost spec
    value: str  # as parsed by `specs.override`
    default: str  # default of the class, "" if it has none
    kind: str  # type or choices, for users
    about: str  # description from the source
    holder: type  # class of the field


def fields_of(spec: Any, prefix: str = "") -> Iterator[SpecField]:
    """List the fields of a spec and of the specs nested in it.

    Args:
      spec: A frozen dataclass.
      prefix: Path of `spec` in an outer spec, with a dot at the end.

    Yields:
      The fields, each followed by those of its nested spec.
    """
    kinds, words = typing.get_type_hints(type(spec)), field_words(type(spec))
    for field in dataclasses.fields(spec):
        value, path = getattr(spec, field.name), prefix + field.name
        yield SpecField(
            path,
            _as_text(value),
            "" if field.default is dataclasses.MISSING else _as_text(field.default),
            _kind_text(kinds[field.name]),
            words[field.name] or _sentences_on(field.name, type(spec)),
            type(spec),
        )
        if dataclasses.is_dataclass(value):
            yield from fields_of(value, f"{path}.")


def _as_text(value: Any) -> str:
    """Format a value as it is written in `path.to.field=value`."""
    if value is None or isinstance(value, bool):
        return str(value).lower()
    if dataclasses.is_dataclass(value):
        return type(value).__name__
    if isinstance(value, tuple):
        return ",".join(map(_as_text, value))
    return str(value)


def _kind_text(kind):
    """Format a type for users, such as `int or none` or `adam or radam`."""
    if typing.get_origin(kind) is typing.Literal:
        return " or ".join(map(str, typing.get_args(kind)))
    if typing.get_origin(kind) is tuple:
        return f"{_kind_text(typing.get_args(kind)[0])},..."
    if kind is type(None):
        return "none"
    if getattr(kind, "_is_protocol", False):
        return "MODULE:NAME"
    parts = typing.get_args(kind)
    if not parts:
        return kind.__name__
    return " or ".join(dict.fromkeys(map(_kind_text, parts)))


def field_words(kind: type) -> dict[str, str]:
    """Collect the descriptions of the fields of a dataclass from its source.

    A description is the docstring below the field, otherwise the comment above and next
    to it.

    Args:
      kind: The dataclass.

    Returns:
      One line for each field, "" if it has no description.
    """
    words: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            words |= _words_of_class(base)
    return words


@functools.cache
def _words_of_class(kind):
    source = textwrap.dedent(inspect.getsource(kind))
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokens
        if token.type == tokenize.COMMENT
    }
    rows = source.splitlines()
    whole_lines = {line for line in comments if rows[line - 1].lstrip().startswith("#")}
    (tree,) = ast.parse(source).body
    words = {}
    for field, below in itertools.pairwise([*tree.body, None]):
        if not isinstance(field, ast.AnnAssign):
            continue
        docstring = getattr(getattr(below, "value", None), "value", None)
        if isinstance(below, ast.Expr) and isinstance(docstring, str):
            words[field.target.id] = " ".join(docstring.split())
            continue
        first = field.lineno
        while first - 1 in whole_lines:
            first -= 1
        lines = range(first, field.end_lineno + 1)
        description = " ".join(comments[line] for line in lines if line in comments)
        words[field.target.id] = description
    return words


def _sentences_on(name, kind):
    """Return the sentences of a class's docstring that name a field in backticks."""
    text = " ".join(inspect.cleandoc(kind.__doc__ or "").split())
    sentences = re.split(r'(?<=[^.\s][.:;])\s(?=[A-Z`"])', text)
    return " ".join(text for text in sentences if f"`{name}`" in text).rstrip(";:")
