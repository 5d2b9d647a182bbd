"""Floor 9: a run and its folder, of whichever representation is installed."""

import importlib

_RUN = (
    "Run",
    "first_state",
    "free_memory",
    "new_run",
    "open_run",
    "read_capture",
    "restore",
    "save_config",
    "saved_run",
    "scene_spec",
    "stored_capture",
)
_RECONSTRUCTION = ("Outcome", "Refused", "reconstruct", "resume")
_MODULES = dict.fromkeys(_RUN, "run") | dict.fromkeys(_RECONSTRUCTION, "reconstruction")


def __getattr__(name):
    # Lazy: the settings of a command (`runs.config`) must not cost an import of JAX.
    if name in _MODULES:
        module = importlib.import_module(f"{__name__}.{_MODULES[name]}")
        return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [*_RUN, *_RECONSTRUCTION]
