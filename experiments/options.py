"""Options from the fields of a settings class, parsed by tyro, with grouped help.

A class may list in `GROUPS` which fields belong under a heading. All others are listed
with `--help`. Docstrings are the help, and "(default: ...)" in them replaces the value
that the class holds.
"""

import dataclasses
import functools
import inspect
import itertools
import operator
import pathlib
import re
import typing
from typing import Annotated, Any, Literal, Protocol

import tyro

from nerfies_jax.training.spec_fields import field_words

READ_BY = (tyro.conf.DisallowNone, tyro.conf.PositionalMetavarFromFieldName)
DEFAULT = re.compile(r"\s*\((default: [^()]*)\)")
JSON = "--json"
JSON_HELP = "Print the result as one JSON document, and words to standard error."
COMPLETION = "--tyro-print-completion"

Entry = tuple[str, Any, Any]  # name, type and field, for `dataclasses.make_dataclass`


class Command(Protocol):
    """A function that runs a command line, with the settings that it reads."""

    settings: Any

    def __call__(self, arguments: list[str] | None = None) -> Any:
        """Run the command, with the words of the process if none are given."""


@dataclasses.dataclass(frozen=True)
class Known:
    """Annotation with names for shell completion. The command refuses others."""

    names: tuple[str, ...]


def parse(settings: Any, arguments: list[str], prog: str) -> Any:
    """Parse a command line.

    Args:
      settings: A frozen dataclass, or a union of those of subcommands.
      arguments: Words of the command line.
      prog: Name of the command in the help.

    Returns:
      The settings.

    Raises:
      ValueError: If the settings refuse a value. Tyro ends the process for unknown
        options.
    """
    offering = any(word.startswith(COMPLETION) for word in arguments)
    settings_by_type = {parser_type(kind, offering): kind for kind in _kinds(settings)}
    union = functools.reduce(operator.or_, settings_by_type)
    parser_values: Any = tyro.cli(union, prog=prog, args=arguments, config=READ_BY)
    return _settle(settings_by_type[type(parser_values)], parser_values)


def completion_type(settings: Any) -> type:
    """Return the type that completes a command among all commands."""
    kinds = [parser_type(kind, offering=True) for kind in _kinds(settings)]
    return kinds[0] if len(kinds) == 1 else several(kinds)


def several(kinds: list[Any]) -> type:
    """Return a type whose subcommands are these types."""
    marks = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
    union: Any = Annotated[(functools.reduce(operator.or_, kinds), *marks)]
    return _settings_class("Several", [("kind", union, dataclasses.field())], "")


def _kinds(settings):
    return typing.get_args(settings) or (settings,)


@functools.cache
def parser_type(settings: type, offering: bool = False, top: bool = True) -> type:
    """Make a class for tyro with the fields of settings, and `--json` at the top.

    Nested settings keep the defaults of their class. `offering` is for the completion
    of a shell, which gets the known names.
    """
    heading_of, docs = _headings(settings), field_words(settings)
    parts: list[Entry] = []
    under: dict[str, list[Entry]] = {heading: [] for heading in heading_of.values()}
    for field, kind, marks in _fields(settings):
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            kind = parser_type(kind, offering, top=False)
            entry = dataclasses.field(default_factory=kind)
            words: dict[str, Any] = {}
            if docs[field.name]:
                words["help"] = docs[field.name]
        else:
            entry = dataclasses.field(default=field.default)
            words = _words(docs.get(field.name, ""), field)
            kind = _plain(kind, marks, offering)
        if field.default is False:
            marks = (*marks, tyro.conf.FlagCreatePairsOff)
        annotation: Any = Annotated[(kind, tyro.conf.arg(**words), *marks)]
        place = under.get(heading_of.get(field.name), parts)
        place.append((field.name, annotation, entry))
    if top:
        marks_of_json = tyro.conf.arg(help=JSON_HELP, help_behavior_hint="")
        flag = Annotated[bool, marks_of_json, tyro.conf.FlagCreatePairsOff]
        parts.append((JSON.strip("-"), flag, dataclasses.field(default=False)))
    groups = list(itertools.starmap(_group, under.items()))
    doc = inspect.cleandoc(settings.__doc__ or "")
    return _settings_class(settings.__name__, [*groups, *parts], doc)


def _group(heading, entries):
    inner = _settings_class(heading, entries, "")
    marks = (tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=""))
    entry = dataclasses.field(default_factory=inner)
    return heading, Annotated[(inner, *marks)], entry


def _settings_class(name, parts, doc):
    record = dataclasses.make_dataclass(name, parts, frozen=True, kw_only=True)
    record.__doc__ = doc
    return record


def _fields(settings):
    """Each field with its bare type and the marks that it is annotated with."""
    hints = typing.get_type_hints(settings, include_extras=True)
    for field in dataclasses.fields(settings):
        kind, marks = hints[field.name], ()
        if typing.get_origin(kind) is Annotated:
            kind, *marks = typing.get_args(kind)
        yield field, kind, marks


def _headings(settings):
    groups = getattr(settings, "GROUPS", {})
    return {name: heading for heading, names in groups.items() for name in names}


def _plain(kind, marks, offering):
    """Return the type on a command line: of a path or a string, the path."""
    choices = next((mark for mark in marks if isinstance(mark, Known)), None)
    several = typing.get_origin(kind) is tuple
    if offering and choices is not None:
        name = Literal[choices.names]
        return tuple[name, ...] if several else name | None
    parts = typing.get_args(kind)
    if pathlib.Path in parts and str in parts:
        return pathlib.Path | None if type(None) in parts else pathlib.Path
    if several and Ellipsis in parts:
        return tuple[_plain(parts[0], (), offering), ...]
    return kind


def _words(doc, field):
    """Help and default of an option, for `tyro.conf.arg`."""
    default = DEFAULT.search(doc)
    words = {"help": DEFAULT.sub("", doc)}
    if default is not None:
        words["help_behavior_hint"] = f"({default[1]})"
    elif field.default in (None, (), False):
        words["help_behavior_hint"] = ""
    return words


def _settle(settings, parser_values):
    """Convert values of the tyro parser to settings."""
    heading_of = _headings(settings)
    values = {}
    for field, kind, _ in _fields(settings):
        heading = heading_of.get(field.name)
        value = getattr(
            parser_values if heading is None else getattr(parser_values, heading),
            field.name,
        )
        values[field.name] = (
            _settle(kind, value) if dataclasses.is_dataclass(kind) else value
        )
    return settings(**values)
