"""Components of a scene from other packages, named as MODULE:NAME.

Loading a component imports its module, which runs code. Only names from the user are
loaded, never names in files (`nerfies_jax.runs.trust`).
"""

import dataclasses
import functools
import importlib
from collections.abc import Iterable
from typing import Any, Protocol, runtime_checkable

SEPARATOR = ":"  # between module and name; names of this package do not contain it


@runtime_checkable
class Settings(Protocol):
    """Settings of a component that depends on the length of a run or on the capture."""

    def bind(self, steps: int, metadata: Any, /) -> Any:
        """Return the object that implements the protocol of the component.

        Args:
          steps: Length of the run.
          metadata: `SceneMetadata` of the representation.

        Returns:
          The object.
        """
        ...


def _is_name(text: str) -> bool:
    """Return whether a text has the form MODULE:NAME."""
    module, colon, name = text.partition(SEPARATOR)
    parts = [*module.split("."), *name.split(".")]
    return bool(colon) and all(part.isidentifier() for part in parts)


def load(name: str) -> Any:
    """Import a component by its name.

    Args:
      name: MODULE:NAME. MODULE is on the import path. NAME is a frozen dataclass, a
        function without required arguments that returns one, or an instance of one.

    Returns:
      The instance. A class or a function is called without arguments.

    Raises:
      ValueError: If there is no such module or name, or it is not a frozen dataclass.
    """
    value = _import(name)
    component = value() if callable(value) and not _is_settings(value) else value
    if not _is_settings(component):
        raise ValueError(
            f"{name} is a {type(component).__name__}; a component of a scene must be "
            "an instance of a frozen dataclass, so that it can be compared and stored "
            "(docs/extending.md)"
        )
    return component


def load_class(name: str) -> type:
    """Import a dataclass or NamedTuple by the name that files store.

    Args:
      name: MODULE:NAME.

    Returns:
      The class.

    Raises:
      ValueError: If there is no such module or name, or it is neither.
    """
    value = _import(name)
    is_record = dataclasses.is_dataclass(value) or hasattr(value, "_fields")
    if not isinstance(value, type) or not is_record:
        raise ValueError(f"{name} is neither a dataclass nor a NamedTuple")
    return value


def _is_settings(value):
    frozen = getattr(type(value), "__dataclass_params__", None)
    return frozen is not None and frozen.frozen


def _import(name):
    if not _is_name(name):
        raise ValueError(f"{name!r}: expected MODULE:NAME, such as my_motion:Drift")
    module_name, _, attribute = name.partition(SEPARATOR)
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ValueError(
            f"{name}: {module_name} cannot be imported ({error}); run in the folder of "
            "its file, or add this folder to PYTHONPATH"
        ) from error
    try:
        return functools.reduce(getattr, attribute.split("."), module)
    except AttributeError as error:
        origin = getattr(module, "__file__", None) or "built into Python"
        raise ValueError(
            f"{name}: {module_name} ({origin}) has no {attribute!r}"
        ) from error


def names_in(document: Any, key: str) -> tuple[str, ...]:
    """Return the names of classes from other packages in JSON values.

    Args:
      document: JSON values of settings.
      key: Key of the class name in a JSON object.

    Returns:
      The names without duplicates, in order.
    """
    names: dict[str, None] = {}

    def visit(value):
        if isinstance(value, list):
            for item in value:
                visit(item)
        elif isinstance(value, dict):
            kind = value.get(key)
            if isinstance(kind, str) and SEPARATOR in kind:
                names[kind] = None
            for item in value.values():
                visit(item)

    visit(document)
    return tuple(names)


def names_in_assignments(assignments: Iterable[str]) -> tuple[str, ...]:
    """Return the values MODULE:NAME of `path.to.field=value` assignments.

    Args:
      assignments: Texts of the form `path.to.field=value`.

    Returns:
      The names, in order.
    """
    values = (text.partition("=")[2].split(",") for text in assignments)
    return tuple(name for value in values for name in value if SEPARATOR in name)


def members(protocol: type) -> list[str]:
    """Return the names of the members that a protocol requires.

    Args:
      protocol: The protocol.

    Returns:
      Names of its methods and properties, sorted.
    """
    return sorted(
        name
        for name, value in vars(protocol).items()
        if (callable(value) or isinstance(value, property)) and name[0] != "_"
    )


def check(field: str, part: Any, protocol: type) -> None:
    """Check that a component implements its protocol.

    Args:
      field: Name of the field or argument for the message.
      part: An object of the protocol, or settings with `bind`.
      protocol: `Regularizer`, or another protocol.

    Raises:
      ValueError: If members are missing.
    """
    if hasattr(part, "bind"):
        return
    missing = [name for name in members(protocol) if not hasattr(part, name)]
    if missing:
        raise ValueError(
            f"{field} is {part!r}, which is no {protocol.__name__}: it has no "
            f"{' and no '.join(missing)}; see docs/extending.md"
        )
