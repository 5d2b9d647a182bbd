"""Parts of a scene from other packages, named as MODULE:NAME.

Loading one imports its module, which runs code. Only names that the user gave are
loaded, never those that a file holds (`nerfies_jax.runs.trust`).
"""

import dataclasses
import functools
import importlib
from collections.abc import Iterable
from typing import Any, Protocol, runtime_checkable

SEPARATOR = ":"  # between module and name; no name of this package has it


@runtime_checkable
class Settings(Protocol):
    """Settings of a part that depends on the length of a run or on the capture."""

    def bind(self, steps: int, metadata: Any, /) -> Any:
        """Return the object with the functions of the part's protocol.

        Args:
          steps: Length of the run.
          metadata: Sizes of the capture, `SceneMetadata` of either package.
        """
        ...


def is_name(text: str) -> bool:
    """Return whether a text has the form MODULE:NAME."""
    module, colon, name = text.partition(SEPARATOR)
    parts = [*module.split("."), *name.split(".")]
    return bool(colon) and all(part.isidentifier() for part in parts)


def load(name: str) -> Any:
    """Import what a name stands for.

    Args:
      name: MODULE:NAME. NAME is a frozen dataclass, a function without required
        arguments that returns one, or an instance of one. MODULE is searched where
        Python searches.

    Returns:
      The instance; a class or a function is called without arguments.

    Raises:
      ValueError: If there is no such module or name, or it is no frozen dataclass.
    """
    found = _import(name)
    part = found() if callable(found) and not _is_settings(found) else found
    if not _is_settings(part):
        raise ValueError(
            f"{name} is a {type(part).__name__}; a part of a scene is an instance of a "
            "frozen dataclass, so that it can be compared and written "
            "(docs/extending.md)"
        )
    return part


def load_class(name: str) -> type:
    """Import the dataclass or NamedTuple of this name, as files hold it.

    Args:
      name: MODULE:NAME.

    Returns:
      The class.

    Raises:
      ValueError: If there is no such module or name, or it is neither.
    """
    found = _import(name)
    record = dataclasses.is_dataclass(found) or hasattr(found, "_fields")
    if not isinstance(found, type) or not record:
        raise ValueError(f"{name} is neither a dataclass nor a NamedTuple")
    return found


def _is_settings(value):
    frozen = getattr(type(value), "__dataclass_params__", None)
    return frozen is not None and frozen.frozen


def _import(name):
    if not is_name(name):
        raise ValueError(f"{name!r}: expected MODULE:NAME, such as my_motion:Drift")
    module_name, _, attribute = name.partition(SEPARATOR)
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ValueError(
            f"{name}: {module_name} cannot be imported ({error}); run where its file "
            "is, or add the folder of the file to PYTHONPATH"
        ) from error
    try:
        return functools.reduce(getattr, attribute.split("."), module)
    except AttributeError as error:
        place = getattr(module, "__file__", None) or "built into Python"
        raise ValueError(
            f"{name}: {module_name} ({place}) has no {attribute!r}"
        ) from error


def names_in(stored: Any, key: str) -> tuple[str, ...]:
    """Return the names of classes from other packages in JSON values.

    Args:
      stored: JSON values of settings.
      key: Key under which an object has the name of its class.

    Returns:
      The names, each once, in their order.
    """
    found: dict[str, None] = {}

    def visit(value):
        if isinstance(value, list):
            for item in value:
                visit(item)
        elif isinstance(value, dict):
            kind = value.get(key)
            if isinstance(kind, str) and SEPARATOR in kind:
                found[kind] = None
            for item in value.values():
                visit(item)

    visit(stored)
    return tuple(found)


def names_in_assignments(assignments: Iterable[str]) -> tuple[str, ...]:
    """Return the values MODULE:NAME of `path.to.field=value` assignments."""
    values = (text.partition("=")[2].split(",") for text in assignments)
    return tuple(name for value in values for name in value if SEPARATOR in name)


def members(protocol: type) -> list[str]:
    """Return the names of the members that a protocol requires."""
    return sorted(
        name
        for name, value in vars(protocol).items()
        if (callable(value) or isinstance(value, property)) and name[0] != "_"
    )


def check(field: str, part: Any, protocol: type) -> None:
    """Raise ValueError unless a part fills its protocol.

    Args:
      field: Name of the field or argument, for the message.
      part: An object of the protocol, or settings with `bind`.
      protocol: `Regularizer`, or another protocol.
    """
    if hasattr(part, "bind"):
        return
    missing = [name for name in members(protocol) if not hasattr(part, name)]
    if missing:
        raise ValueError(
            f"{field} is {part!r}, which is no {protocol.__name__}: it has no "
            f"{' and no '.join(missing)}; see docs/extending.md"
        )
