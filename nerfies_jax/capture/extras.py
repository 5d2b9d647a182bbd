"""Optional dependencies (pip extras), imported on first use."""

import importlib
import importlib.util
import types


class MissingExtra(ModuleNotFoundError, ValueError):
    """A package of an extra that is not installed."""


def library(name: str, extra: str) -> types.ModuleType:
    """Import a package of an extra.

    Args:
      name: Name of the module.
      extra: Name of the extra.

    Returns:
      The module.

    Raises:
      MissingExtra: If it is not installed, with the name of the extra.
    """
    check(name, extra)
    return importlib.import_module(name)


def check(name: str, extra: str) -> None:
    """Check that a package of an extra is installed, without importing it.

    Args:
      name: Name of the module.
      extra: Name of the extra.

    Raises:
      MissingExtra: If it is not installed, with the name of the extra.
    """
    package = name.partition(".")[0]
    if importlib.util.find_spec(package) is None:
        raise MissingExtra(
            f"this needs the package {package}, which is not installed: "
            f"pip install 'nerfies-jax[{extra}]' (in a clone of it '.[{extra}]')"
        )
