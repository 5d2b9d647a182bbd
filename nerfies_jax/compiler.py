"""XLA's compiler: what it leaves out, and its work beside what else there is to do."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

# Options for `jax.jit` and `Lowered.compile`: XLA:CPU does not divide each loop among
# the cores that a device sees. Of a raster, whose loops are short, that costs more than
# it gains: with two cores, one device and JAX as it comes, a step of
# `splats-tracked-small` takes 37 ms for 55, a frame 8 for 16. Of fields it is left
# alone: divided, their steps take 8 % less.
UNDIVIDED = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}

_COMPILER = ThreadPoolExecutor(1, "compiler")


def begun(work: Callable[[], Result]) -> Future[Result]:
    """`work` in a thread, after what was begun before it.

    Trace and lower before: that goes by the settings of the caller's thread (x64, the
    precision of products) and holds Python's lock. Compiling does neither.
    """
    return _COMPILER.submit(work)
