"""Trust in run folders: nothing is imported just because a file names it."""

import pathlib
from collections.abc import Collection
from typing import Any

from nerfies_jax.training import extensions, specs


class UntrustedCode(ValueError):
    """A run folder needs code that the caller did not name.

    Attributes:
      names: Names of that code, as MODULE:NAME.
    """

    def __init__(self, folder: pathlib.Path, names: tuple[str, ...]):
        super().__init__(
            f"{folder}: the run uses parts from outside of this package "
            f"({', '.join(names)}), which run code when they are loaded; name each of "
            "them if you trust it"
        )
        self.names = names


def check(
    folder: pathlib.Path, stored: Any, spec_type: type, trusted: Collection[str]
) -> None:
    """Refuse code that a run folder asks for and its reader did not name.

    Args:
      folder: The run folder.
      stored: Its settings, as `config.json` holds them.
      spec_type: Settings of a scene of its representation.
      trusted: The names MODULE:NAME that the caller trusts. They are compared as text.

    Raises:
      UntrustedCode: If some names are not in `trusted`.
      ValueError: If the overrides are no texts.
    """
    try:
        wanted = outside_names(stored, spec_type)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    unnamed = tuple(name for name in wanted if name not in trusted)
    if unnamed:
        raise UntrustedCode(folder, unnamed)


def outside_names(stored: Any, spec_type: type) -> tuple[str, ...]:
    """Return the names of code from other packages that settings need.

    Args:
      stored: The settings of a run as JSON values, as `config.json` holds them.
      spec_type: Settings of a scene. It and all that its annotated fields can hold are
        known without importing anything.

    Returns:
      The names, each MODULE:NAME once: values of overrides, and the classes of the
      scene's parts.

    Raises:
      ValueError: If the overrides are no texts.
    """
    config = stored["config"]
    overrides = config.get("overrides", ())
    if not isinstance(overrides, tuple | list) or not all(
        isinstance(each, str) for each in overrides
    ):
        raise ValueError(f"its overrides are {overrides!r}, which are no texts")
    known = specs.allowed_names(spec_type)
    parts = [
        name
        for name in extensions.names_in(stored.get("spec"), specs.TYPE)
        if name not in known
    ]
    named = extensions.names_in_assignments(overrides)
    return tuple(dict.fromkeys((*named, *parts)))
