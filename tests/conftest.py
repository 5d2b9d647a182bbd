"""Both precisions, strict promotion, one compilation cache for the whole run."""

import gc
import itertools
import os
import pathlib
import signal
import tempfile

# XLA:CPU splits the bodies of tight loops over all visible cores, which slows the
# rasterizer about twofold and makes results depend on the core count; one core per
# test process pins the bits. xdist workers then share the machine evenly.
os.environ.setdefault("PJRT_NPROC", "1")
os.environ.setdefault("NPROC", "1")

import jax
import jax.numpy as jnp
import numpy as np
import pytest

# CPython 3.11 keeps the depth of a syntax tree under construction in one place for all
# threads, and a collection in the middle of it (JAX hangs Python code onto collections)
# now and then ends an import with "AST constructor recursion depth mismatch". Imports
# build such trees for the shape checks, so nothing is collected until they are done.
gc.disable()

jax.config.update("jax_numpy_dtype_promotion", "strict")
_CACHE = os.environ.get(
    "JAX_COMPILATION_CACHE_DIR",
    str(pathlib.Path(tempfile.gettempdir()) / "nerfies_jax_test_cache"),
)
jax.config.update("jax_compilation_cache_dir", _CACHE)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

# A run in the background inherits ignored signals, and what they do is tested.
signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP"):  # not on Windows
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

pytest_plugins = ["tests.budget"]

# Programs are compiled roughly, in half the time, unless hard cases are asked for:
# `-m hard_cases` runs all of those, of each tier, as users' programs are compiled.
# In one part each: a process has one core, and parts cost a tenth more.
ROUGH = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)

SHARED = pathlib.Path(__file__).resolve().parents[2] / "shared"


# The longest files come first: workers then end together, not half a minute apart.
# Hostile starts are too long for one worker: what a parameter of the name given stands
# for is compiled once, and shared by all tests that have it.
LONGEST = {
    "test_notebooks.py": ("notebook",),
    "test_reconstruct.py": (),
    "test_hostile_fields.py": ("name",),
    "test_hostile_splats.py": ("name",),
    "test_track_start.py": (),
    "test_splat_cases.py": (),
    "test_elastic_cases.py": (),
    "test_presets.py": ("name",),
    "test_values_and_slopes.py": ("topic",),
    "test_contracts.py": (),
    "test_effect_cost.py": (),
    "test_inspection_truth.py": ("name",),
}


def pytest_configure(config):
    # The flags are read when the first array is made.
    if config.getoption("markexpr") != "hard_cases":
        os.environ.setdefault("XLA_FLAGS", ROUGH)


# First: xdist reads the groups in its own, later, turn.
@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        if "float64" in item.name:  # which CI compiles roughly, hard cases too
            item.add_marker("float64")
        group = item.path.name
        values = item.callspec.params if hasattr(item, "callspec") else {}
        for name in LONGEST.get(group, ()):
            if name in values:
                shared = values[name]
                group = f"{group}-{getattr(shared, 'name', shared)}"
                break
        item.add_marker(pytest.mark.xdist_group(f"{item.path.parent.name}/{group}"))
    order = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


def pytest_collection_finish():
    # What was imported stays: it need not be looked through again and again, nor after
    # every 700 of the many small objects of which JAX builds programs (a tenth of the
    # processor seconds of a file).
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 50, 100)
    gc.enable()


# All programs of a run together took 5 GB a process; with these it peaks below 3 GB.
REMEMBERED = 4
_remembered = itertools.count(1)


@pytest.fixture(scope="module", autouse=True)
def forget_programs():
    """Compiled programs of finished modules, now and then.

    Not of each: small operations are the same in all, and a worker that takes tests of
    two files by turns would compile everything again at each turn.
    """
    yield
    if next(_remembered) % REMEMBERED == 0:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(params=["float32", pytest.param("float64", marks=pytest.mark.full)])
def dtype(request):
    """The precision a test runs in: float32 in core, both in full.

    float32 runs with x64 off, because x64 silently promotes float32 code through
    Python-made constants and so hides its failures; float64 runs with x64 on.
    """
    with jax.enable_x64(request.param == "float64"):
        yield request.param


@pytest.fixture
def float64():
    """A test that runs in float64 only (gradient checks, parity)."""
    with jax.enable_x64(True):
        yield jnp.float64


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def oracle_dir():
    """Reference values kept beside the checkout; skips where they are absent."""
    return _shared("oracle")


@pytest.fixture(scope="session")
def data_dir():
    """Real captures kept beside the checkout; skips where they are absent."""
    return _shared("data")


def _shared(name):
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"no reference {name} beside this checkout")
    return folder
