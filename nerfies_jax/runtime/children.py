"""Child processes that end when their parent ends, for whatever reason.

The parent starts a Python program with `start`, or a pool of processes with
`end_with_parent` as its initializer. The child calls `end_with_parent`. Linux then
kills it together with its parent. On other systems a thread of the child checks whether
the parent is still running.
"""

import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

from nerfies_jax.runtime import stopping

PARENT = "NERFIES_JAX_PARENT"  # environment variable with the process id of the parent
POLL_SECONDS = 0.5
_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of linux/prctl.h

_children: "weakref.WeakSet[subprocess.Popen]" = weakref.WeakSet()


def environment(base: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return an environment for a program that calls `end_with_parent`.

    Args:
      base: Other variables. None for the environment of this process.

    Returns:
      The variables.
    """
    return {**(os.environ if base is None else base), PARENT: str(os.getpid())}


def start(command: Sequence[str | os.PathLike], **options: Any) -> subprocess.Popen:
    """Start a program that calls `end_with_parent`.

    Args:
      command: The program and its arguments.
      **options: Options of `subprocess.Popen`.

    Returns:
      The process.
    """
    child = subprocess.Popen(
        command, env=environment(options.pop("env", None)), **options
    )
    _children.add(child)
    stopping.at_end(_kill)
    return child


def _kill():
    """Kill the children, so that their incomplete files can be removed."""
    for child in list(_children):
        if child.returncode is None:
            child.kill()


def end_with_parent(parent: int | None = None) -> None:
    """Make this process end when its parent does. Call it early in a child.

    Args:
      parent: Process id of the parent. None for the one that `start` has passed in the
        environment. Without any, the function does nothing.
    """
    parent = parent or int(os.environ.pop(PARENT, "0"))
    if not parent:
        return
    if sys.platform != "linux" or not _ask_kernel():
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    if not _is_running(parent):  # it ended before the call
        os._exit(128 + signal.SIGTERM)


def _ask_kernel() -> bool:
    import ctypes

    try:
        prctl = ctypes.CDLL(None).prctl
    except (OSError, AttributeError):
        return False
    return prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL) == 0


def _watch(parent):
    while _is_running(parent):
        time.sleep(POLL_SECONDS)
    os._exit(128 + signal.SIGTERM)


def _is_running(parent):
    if os.name == "posix":  # an orphan is adopted by another process
        return os.getppid() == parent
    import psutil

    return psutil.pid_exists(parent)
