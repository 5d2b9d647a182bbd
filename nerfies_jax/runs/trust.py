"""Trust in run folders: nothing is imported just because a file names it."""

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
    """Refuse effects of a run folder that its reader did not name.

    Args:
      folder: The run folder.
      wanted: Effects that its settings name, as MODULE:NAME.
      trusted: Effects that the caller named. They are compared as text.

    Raises:
      UntrustedEffects: If some of `wanted` are not in `trusted`.
      ValueError: If `wanted` are no names.
    """
    if not isinstance(wanted, tuple | list) or not all(
        isinstance(name, str) for name in wanted
    ):
        raise ValueError(f"{folder}: its effects are {wanted!r}, which are no names")
    unnamed = tuple(name for name in wanted if name not in trusted)
    if unnamed:
        raise UntrustedEffects(folder, unnamed)
