"""Earlier names of modules and functions, which scripts of users still have."""

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
import warnings
from collections.abc import Callable
from typing import Any

# Packages and modules by their earlier names. Modules of a package moved with it.
CURRENT = {
    "nerfies_jax.capture.given": "nerfies_jax.capture.external",
    "nerfies_jax.evidence": "nerfies_jax.preprocessing",
    "nerfies_jax.preprocessing.given_files": "nerfies_jax.preprocessing.external_files",
    "nerfies_jax.preprocessing.rest_points": "nerfies_jax.preprocessing.static_points",
    "nerfies_jax.preprocessing.still_points": "nerfies_jax.preprocessing.dense_points",
    "nerfies_jax.measure": "nerfies_jax.metrics",
    "nerfies_jax.nets": "nerfies_jax.nn",
    "gaussians_jax.files": "gaussians_jax.io.files",
    "gaussians_jax.instants": "gaussians_jax.io.single_time",
    "gaussians_jax.io.instants": "gaussians_jax.io.single_time",
    "gaussians_jax.io.sampled": "gaussians_jax.io.keyframes",
    "gaussians_jax.model_file": "gaussians_jax.io.model_file",
    "gaussians_jax.splats": "gaussians_jax.core.splats",
    "gaussians_jax.splatv": "gaussians_jax.io.splatv",
    "gaussians_jax.spz": "gaussians_jax.io.spz",
}
# Functions and classes of modules, by their earlier names.
ATTRIBUTES = {
    "nerfies_jax.capture.external.GivenFiles": (
        "nerfies_jax.capture.external.ExternalFiles"
    ),
    "nerfies_jax.capture.footage.from_film": "nerfies_jax.capture.footage.from_video",
    "nerfies_jax.capture.footage.from_pictures": (
        "nerfies_jax.capture.footage.from_images"
    ),
    "nerfies_jax.capture.frames.pixels_of": (
        "nerfies_jax.capture.world_points.pixels_of"
    ),
}


def current_name(name: str) -> str | None:
    """Return the name of a module that was renamed.

    Args:
      name: Dotted name.

    Returns:
      Its name in this version, or None if it was not renamed.
    """
    parts = name.split(".")
    for count in range(len(parts), 1, -1):
        current = CURRENT.get(".".join(parts[:count]))
        if current is not None:
            return ".".join([current, *parts[count:]])
    return None


def attributes(module: str) -> Callable[[str], Any]:
    """Make the `__getattr__` of a module that had names of `ATTRIBUTES`.

    Args:
      module: Dotted name of the module.

    Returns:
      A function from an earlier name to the value that has another name now.
    """

    def get(name: str) -> Any:
        earlier = f"{module}.{name}"
        if earlier not in ATTRIBUTES:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        current = ATTRIBUTES[earlier]
        warnings.warn(
            f"{earlier} is {current} in this version; use that",
            DeprecationWarning,
            stacklevel=2,
        )
        home, _, last = current.rpartition(".")
        return getattr(importlib.import_module(home), last)

    return get


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
