"""Optional dependencies (pip extras), imported on first use."""

import importlib
import importlib.util
import platform
import types

# Modules of extras that have no distribution for some machines (pyproject.toml).
_MACHINES = {
    "pycolmap": {"Linux": ("x86_64",), "Darwin": ("arm64",), "Windows": ("AMD64",)}
}


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
        system, machine = platform.system(), platform.machine()
        if machine not in _MACHINES.get(package, {}).get(system, (machine,)):
            raise MissingExtra(
                f"this needs the package {package}, which has no release for {system} "
                f"on {machine}; do this step on another machine or build {package} "
                "from its source"
            )
        raise MissingExtra(
            f"this needs the package {package}, which is not installed: "
            f"pip install 'nerfies-jax[{extra}]' (in a clone of it '.[{extra}]')"
        )
