"""Run folders of strangers: nothing is imported because a file says so."""

import pathlib
from collections.abc import Collection
from typing import Any


class UntrustedEffects(ValueError):
    """A run folder names effects that the caller did not name.

    Attributes:
      names: Those effects, as MODULE:NAME.
    """

    def __init__(self, folder: pathlib.Path, names: tuple[str, ...]):
        super().__init__(
            f"{folder}: the run uses effects from outside of this package "
            f"({', '.join(names)}), which run code when they are loaded; name each of "
            "them if you trust it"
        )
        self.names = names


def check_effects(folder: pathlib.Path, wanted: Any, trusted: Collection[str]) -> None:
    """Refuse the effects that a run folder asks for and its reader did not name.

    Args:
      folder: The run folder.
      wanted: The effects that its settings name, as MODULE:NAME.
      trusted: The effects that the caller named. They are compared as text.

    Raises:
      UntrustedEffects: Some of `wanted` are not in `trusted`.
      ValueError: `wanted` are no names.
    """
    if not isinstance(wanted, tuple | list) or not all(
        isinstance(name, str) for name in wanted
    ):
        raise ValueError(f"{folder}: its effects are {wanted!r}, which are no names")
    unnamed = tuple(name for name in wanted if name not in trusted)
    if unnamed:
        raise UntrustedEffects(folder, unnamed)
