"""How many programs a block compiles, with a compilation cache of its own."""

import contextlib

import jax
from jax.experimental.compilation_cache import compilation_cache

MISS = "/jax/compilation_cache/cache_misses"


@contextlib.contextmanager
def counted(folder):
    """Yield a function that returns the number of compilations since its last call."""
    misses = 0

    def listen(event, **_):
        nonlocal misses
        misses += event == MISS

    def since():
        nonlocal misses
        count, misses = misses, 0
        return count

    before = jax.config.jax_compilation_cache_dir
    jax.monitoring.register_event_listener(listen)
    _use(folder)
    jax.clear_caches()  # else the count depends on the tests before
    try:
        yield since
    finally:
        jax.monitoring.unregister_event_listener(listen)
        _use(before)


def _use(folder):
    jax.config.update("jax_compilation_cache_dir", str(folder))
    compilation_cache.reset_cache()  # it is opened once otherwise
