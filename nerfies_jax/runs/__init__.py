"""Floor 9: a run and its folder, of whichever representation is installed."""


def __getattr__(name):
    # Lazy: the settings of a command (`runs.config`) must not cost an import of JAX.
    if name in __all__:
        from nerfies_jax.runs import run

        return getattr(run, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
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
]
