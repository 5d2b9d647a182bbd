"""Options of XLA's compiler, and compilation in the background."""

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
    """Run a function in a background thread, after those begun before it.

    Trace and lower before calling it: both depend on the settings of the caller's
    thread (x64, the precision of products) and hold Python's lock. Compiling does
    neither.

    Args:
      work: The function.

    Returns:
      A future of its result.
    """
    return _COMPILER.submit(work)
