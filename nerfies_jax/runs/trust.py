"""Protection from code that untrusted run folders name."""

import pathlib
from collections.abc import Collection
from typing import Any

from nerfies_jax.training import extensions, specs


class UntrustedCode(ValueError):
    """A run folder needs code that the caller did not declare as trusted.

    Attributes:
      names: Names of that code, as MODULE:NAME.
    """

    def __init__(self, folder: pathlib.Path, names: tuple[str, ...]):
        super().__init__(
            f"{folder}: the run uses code from other packages ({', '.join(names)}), "
            "which is executed when it is loaded; name each part if you trust it"
        )
        self.names = names


def check(
    folder: pathlib.Path, stored: Any, spec_type: type, trusted: Collection[str]
) -> None:
    """Refuse a run folder that needs code which the caller does not trust.

    Args:
      folder: The run folder.
      stored: Its settings, as stored in `config.json`.
      spec_type: Type of the specs of its representation.
      trusted: Names MODULE:NAME that the caller trusts. They are compared as text.

    Raises:
      UntrustedCode: If some names are not in `trusted`.
      ValueError: If the overrides are not strings.
    """
    try:
        names = outside_names(stored, spec_type)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    untrusted_names = tuple(name for name in names if name not in trusted)
    if untrusted_names:
        raise UntrustedCode(folder, untrusted_names)


def outside_names(stored: Any, spec_type: type) -> tuple[str, ...]:
    """Return the names of code from other packages that settings need.

    Args:
      stored: The settings of a run as JSON values, as stored in `config.json`.
      spec_type: Type of the specs of a representation. It and all types in the
        annotations of its fields are known without importing anything.

    Returns:
      The unique names MODULE:NAME in values of overrides and in types of the spec.

    Raises:
      ValueError: If the overrides are not strings.
    """
    config = stored["config"]
    overrides = config.get("overrides", ())
    if not isinstance(overrides, tuple | list) or not all(
        isinstance(each, str) for each in overrides
    ):
        raise ValueError(f"overrides must be strings, got {overrides!r}")
    allowed_names = specs.allowed_names(spec_type)
    in_spec = [
        name
        for name in extensions.names_in(stored.get("spec"), specs.TYPE)
        if name not in allowed_names
    ]
    in_overrides = extensions.names_in_assignments(overrides)
    return tuple(dict.fromkeys((*in_overrides, *in_spec)))
