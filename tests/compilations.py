"""How many programs a block compiles, with a compilation cache of its own."""

import contextlib

import jax
from jax.experimental.compilation_cache import compilation_cache

MISS = "/jax/compilation_cache/cache_misses"
SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
)


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

    before = {name: getattr(jax.config, name) for name in SETTINGS}
    jax.monitoring.register_event_listener(listen)
    # JAX counts programs that it stores, and by default not those that compile fast.
    _use(dict(zip(SETTINGS, (str(folder), 0.0), strict=True)))
    jax.clear_caches()  # else the count depends on the tests before
    try:
        yield since
    finally:
        jax.monitoring.unregister_event_listener(listen)
        _use(before)


def _use(settings):
    for name, value in settings.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()  # it is opened once otherwise
