"""Packages that are installed with an extra of this one, loaded where they are used."""

import importlib
import importlib.util
import types


class MissingExtra(ModuleNotFoundError, ValueError):
    """A package is wanted that is installed with an extra only."""


def library(name: str, extra: str) -> types.ModuleType:
    """The module of an extra's package, loaded now.

    Raises MissingExtra, which names the extra, where it is not installed.
    """
    check(name, extra)
    return importlib.import_module(name)


def check(name: str, extra: str) -> None:
    """Raise MissingExtra where the module is not installed; nothing is loaded."""
    package = name.partition(".")[0]
    if importlib.util.find_spec(package) is None:
        raise MissingExtra(
            f"this needs the package {package}, which is not installed: "
            f"pip install 'nerfies-jax[{extra}]' (in a clone of it '.[{extra}]')"
        )
