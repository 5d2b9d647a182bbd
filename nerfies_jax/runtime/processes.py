"""Unique names of processes, from which others can test if a process has ended."""

import functools
import hashlib
import os
import pathlib
import platform
import re

PATTERN = r"(?P<pid>\d+)-(?P<start>\d+)-(?P<machine>[0-9a-f]{6})"


def own_name() -> str:
    """Return the name of this process: its id, its start and its machine.

    Returns:
      The name.
    """
    pid = os.getpid()
    return f"{pid}-{_start_of(pid) or 0}-{machine()}"


def has_ended(name: str) -> bool:
    """Test if the process with a name has ended.

    A process of another machine or another container is assumed to be running.

    Args:
      name: Result of `own_name` in that process.

    Returns:
      True if it has ended.
    """
    parts = re.fullmatch(PATTERN, name)
    if parts is None or parts["machine"] != machine():
        return False
    return _start_of(int(parts["pid"])) != (int(parts["start"]) or None)


@functools.lru_cache(maxsize=1)
def machine() -> str:
    """Return six hexadecimal digits of this machine and its process namespace.

    Returns:
      The digits.
    """
    try:  # process ids are unique only within a container
        processes = os.readlink("/proc/self/ns/pid")
    except OSError:
        processes = ""
    return hashlib.sha256((platform.node() + processes).encode()).hexdigest()[:6]


def _start_of(pid):
    """Return the start time of a process, or None if it has ended."""
    try:
        stat = pathlib.Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None if pathlib.Path("/proc/self/stat").exists() else _creation_time(pid)
    # The name of the program, in parentheses, may contain any characters.
    state, *fields = stat.rpartition(")")[2].split()
    return None if state in "ZX" else int(fields[18])  # clock ticks since boot


def _creation_time(pid):
    import psutil

    try:
        return int(psutil.Process(pid).create_time())
    except psutil.Error:
        return None
