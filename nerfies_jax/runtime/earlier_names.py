"""Imports of modules under their earlier names, which scripts of users still have."""

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
import warnings
from typing import Any

# Packages and modules by their earlier names. Modules of a package moved with it.
CURRENT = {
    "nerfies_jax.evidence": "nerfies_jax.preprocessing",
    "nerfies_jax.measure": "nerfies_jax.metrics",
    "nerfies_jax.nets": "nerfies_jax.nn",
    "gaussians_jax.files": "gaussians_jax.io.files",
    "gaussians_jax.instants": "gaussians_jax.io.instants",
    "gaussians_jax.model_file": "gaussians_jax.io.model_file",
    "gaussians_jax.splats": "gaussians_jax.core.splats",
    "gaussians_jax.splatv": "gaussians_jax.io.splatv",
    "gaussians_jax.spz": "gaussians_jax.io.spz",
}


def current_name(name: str) -> str | None:
    """Return the name of a module that was renamed.

    Args:
      name: Dotted name.

    Returns:
      Its name in this version, or None if it was not renamed.
    """
    parts = name.split(".")
    current = CURRENT.get(".".join(parts[:2]))
    return None if current is None else ".".join([current, *parts[2:]])


class _Loader(importlib.abc.Loader):
    """Load a module under an earlier name as the one module that it is now."""

    def __init__(self, name: str):
        self.name = name
        self.spec: importlib.machinery.ModuleSpec | None = None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType:
        warnings.warn(
            f"{spec.name} is {self.name} in this version; import that",
            DeprecationWarning,
            stacklevel=2,
        )
        module = importlib.import_module(self.name)
        self.spec = module.__spec__
        return module

    def exec_module(self, module: types.ModuleType) -> None:
        module.__spec__ = self.spec  # the import system replaced it


class _Finder(importlib.abc.MetaPathFinder):
    """Find modules by their earlier names."""

    def find_spec(
        self,
        fullname: str,
        path: Any,  # of the package, of which the import system has its own type
        target: types.ModuleType | None = None,
    ) -> importlib.machinery.ModuleSpec | None:
        name = current_name(fullname)
        if name is None:
            return None
        return importlib.machinery.ModuleSpec(fullname, _Loader(name))


def install() -> None:
    """Let modules be imported under their earlier names."""
    # In front: a module of a renamed package would be found in it and loaded again.
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
