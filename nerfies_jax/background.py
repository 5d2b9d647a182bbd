"""Work of XLA's compiler beside what else there is to do."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

_COMPILER = ThreadPoolExecutor(1, "compiler")


def begun(work: Callable[[], Result]) -> Future[Result]:
    """`work` in a thread, after what was begun before it.

    Trace and lower before: that goes by the settings of the caller's thread (x64, the
    precision of products) and holds Python's lock. Compiling does neither.
    """
    return _COMPILER.submit(work)
