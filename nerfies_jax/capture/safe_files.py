"""Safe opening of untrusted files: regular, inside their folder, bounded in size.

All readers of captures open files through this module, or check them right before they
pass the path to a library. Links that lead out of the capture are therefore refused
when the file is opened, even if the link changed after the name was checked.
"""

import contextlib
import contextvars
import functools
import io
import os
import pathlib
import stat
from collections.abc import Callable, Iterator
from typing import Any, Concatenate, ParamSpec, TypeVar

from nerfies_jax.capture import decoder
from nerfies_jax.capture.errors import CaptureError

AnyPath = str | os.PathLike
Parameters = ParamSpec("Parameters")
Content = TypeVar("Content")

# Real path of the folder that all files must lie in, None for any.
_folder: contextvars.ContextVar[str | None] = contextvars.ContextVar(
    "folder", default=None
)


@contextlib.contextmanager
def _confine(folder: str | None) -> Iterator[None]:
    """Refuse to open files outside of a real path within the block, in this thread."""
    token = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(token)


def confines(
    read: Callable[Concatenate[AnyPath, Parameters], Content],
) -> Callable[Concatenate[AnyPath, Parameters], Content]:
    """Decorate a reader of captures so that it can only open files of the capture.

    Args:
      read: Reader that takes the path of a folder, or of a file whose folder is the
        capture.

    Returns:
      The confined reader.
    """

    @functools.wraps(read)
    def confined_read(
        path: AnyPath, *args: Parameters.args, **options: Parameters.kwargs
    ) -> Content:
        folder = path if os.path.isdir(path) else pathlib.Path(path).parent
        with _confine(os.path.realpath(folder)), decoder.session():
            return read(path, *args, **options)

    return confined_read


def carried(function: Callable[..., Content]) -> Callable[..., Content]:
    """Wrap a function so that the caller's `confined` folder holds in other threads.

    Args:
      function: The function.

    Returns:
      The confined function.
    """
    folder = _folder.get()

    def run(*args: Any) -> Content:
        with _confine(folder):
            return function(*args)

    return run


def check(path: AnyPath) -> pathlib.Path:
    """Check a file right before it is opened.

    Args:
      path: The file.

    Returns:
      The path.

    Raises:
      CaptureError: If it does not exist, is not a regular file, or lies outside the
        folder that is being read.
    """
    path = pathlib.Path(path)
    _check_folder(path)
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:  # ValueError: a null character
        raise _missing(path, error) from None
    _check_kind(path, mode)
    return path


def open_file(path: AnyPath) -> io.BufferedReader:
    """Open a file for reading, with the checks of `check`.

    Args:
      path: The file.

    Returns:
      The open file.

    Raises:
      CaptureError: As for `check`.
    """
    path = pathlib.Path(path)
    _check_folder(path)
    try:
        # Nonblocking, since opening a named pipe would block otherwise.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        descriptor = os.open(path, flags)
    except (OSError, ValueError) as error:
        raise _missing(path, error) from None
    try:
        _check_kind(path, os.fstat(descriptor).st_mode)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(path: AnyPath, most: int) -> bytes:
    """Read a whole file.

    Args:
      path: The file.
      most: Largest number of bytes.

    Returns:
      The contents.

    Raises:
      CaptureError: As for `check`, or if the file is larger.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        try:
            content = file.read(most + 1) if size <= most else b""
        except OSError as error:
            raise _missing(path, error) from None
    if max(size, len(content)) > most:
        raise CaptureError(
            f"{path}: {max(size, len(content))} bytes; at most {most} are read, so "
            "split it or make it smaller"
        )
    return content


def _check_folder(path):
    folder = _folder.get()
    if folder is None:
        return
    try:
        real = os.path.realpath(path)
    except (OSError, ValueError) as error:
        raise _missing(path, error) from None
    if not pathlib.Path(real).is_relative_to(folder):
        raise CaptureError(
            f"{path}: leads outside the capture, to {real}; names and links must stay "
            f"in {folder}, so copy the file there"
        )


def _check_kind(path, mode):
    if not stat.S_ISREG(mode):
        raise CaptureError(f"{path}: not a regular file; restore it or remove it")


def _missing(path, error):
    reason = getattr(error, "strerror", None) or error
    return CaptureError(f"{path!s}: {reason}; check the path")
