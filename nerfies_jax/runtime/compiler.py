"""Options of XLA's compiler, and compilation in the background."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

# Options for `jax.jit` and `Lowered.compile` that keep XLA:CPU from dividing each loop
# among the cores that a device sees. The loops of rasterization are too short for that.
# With two cores, one device and the defaults of JAX, a step of `splats-tracked-small`
# takes 37 ms with these options instead of 55 ms, and a frame 8 ms instead of 16 ms.
# Radiance fields do not use them, because divided loops make their steps 8 % faster.
UNDIVIDED = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}

_COMPILER = ThreadPoolExecutor(1, "compiler")


def begun(work: Callable[[], Result]) -> Future[Result]:
    """Run a function in a background thread, after all earlier ones.

    Trace and lower a program before calling it: both depend on the JAX settings of the
    calling thread (x64, matrix precision) and hold the GIL. Compilation does neither.

    Args:
      work: The function.

    Returns:
      A future of its result.
    """
    return _COMPILER.submit(work)
