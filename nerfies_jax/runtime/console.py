"""Messages to the user. Failing to write them never ends the work.

Every message of the packages goes through `say`, `note`, `warn` and `error`. If the
reader of a pipe has ended (`reconstruct ... | head`), the disk of a log file is full or
a stream is closed, only messages are lost: the first error is stored, the descriptor is
redirected to the null device, and the work continues. A `session` does the same for the
output of other libraries, and determines the exit code of a command.
"""

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any

# Writes lines above a progress display on the terminal.
_above: Callable[[str], None] | None = None


def say(text: object = "") -> None:
    """Write a line of a command's results to stdout.

    Args:
      text: The line.
    """
    _write_line("stdout", str(text))


def note(text: object = "") -> None:
    """Write a line about the progress of the work to stderr.

    Args:
      text: The line.
    """
    _write_line("stderr", str(text))


def warn(text: object) -> None:
    """Write a line to stderr that begins with `warning: `.

    Args:
      text: The line.
    """
    note(f"warning: {text}")


def error(text: object) -> None:
    """Write a line to stderr that begins with `error: `.

    Args:
      text: The line.
    """
    note(f"error: {text}")


def _write_line(name, text):
    stream = safe(name)
    if _above is not None and stream.isatty():
        _above(text)
    else:
        # A single write, so that lines of several processes in one log are not mixed.
        stream.write(text + "\n")


@contextlib.contextmanager
def display(above: Callable[[str], None]) -> Iterator[None]:
    """Send lines for a terminal to `above` while the block runs.

    Args:
      above: Writes a line above a progress display at the bottom of the terminal.

    Yields:
      None.
    """
    global _above
    before, _above = _above, above
    try:
        yield
    finally:
        _above = before


class SafeStream:
    """A text stream whose `write` and `flush` never raise errors of its file.

    Attributes:
      failure: The first error, or None if there was none.
    """

    def __init__(self, stream: Any):
        self._stream = stream
        self.failure: OSError | None = None

    def write(self, text: str) -> int:
        """Write text, and flush it if it contains the end of a line.

        Otherwise the buffer of a pipe would delay lines.

        Args:
          text: The text.

        Returns:
          Number of characters.
        """
        self._attempt(self._write, text)
        if "\n" in text:
            self.flush()
        return len(text)

    def _write(self, text):
        try:
            self._stream.write(text)
        except UnicodeEncodeError:
            encoding = self._stream.encoding
            printable = text.encode(encoding, "backslashreplace").decode(encoding)
            self._stream.write(printable)

    def writelines(self, lines) -> None:
        """Write several lines.

        Args:
          lines: The lines.
        """
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush the buffer."""
        self._attempt(lambda: self._stream.flush())

    def isatty(self) -> bool:
        """Test if this is a terminal.

        Returns:
          True for a terminal.
        """
        try:
            return self._stream is not None and self._stream.isatty()
        except ValueError:  # closed
            return False

    def _attempt(self, action, *arguments):
        if self._stream is None:  # the descriptor was closed when Python started
            return
        try:
            action(*arguments)
        except BlockingIOError:
            pass  # slow reader: the text stays in the buffer until the next flush
        except RuntimeError:
            pass  # reentrant call from a signal handler during a write
        except (OSError, ValueError) as problem:
            is_os_error = isinstance(problem, OSError)
            self._give_up(problem if is_os_error else OSError(str(problem)))

    def _give_up(self, problem):
        self.failure = self.failure or problem
        # The rest of the buffer is written to the null device, too. Otherwise Python
        # would fail to flush it at exit, with code 120.
        with contextlib.suppress(OSError, ValueError):
            _point_at_null(self._stream.fileno())
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def safe(name: str) -> SafeStream:
    """Wrap `sys.stdout` or `sys.stderr` in a stream that never raises.

    Args:
      name: `"stdout"` or `"stderr"`.

    Returns:
      The stream.
    """
    stream = getattr(sys, name)
    return stream if isinstance(stream, SafeStream) else SafeStream(stream)


def _point_at_null(descriptor):
    null = os.open(os.devnull, os.O_RDWR)
    try:
        os.dup2(null, descriptor)
    finally:
        os.close(null)


def open_descriptors() -> None:
    """Open the null device in place of standard streams that are closed.

    Otherwise the next file to be opened gets the descriptor of the stream, and native
    libraries would write their error messages into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # `os.open` returns the lowest free descriptor, which is this one.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
            if getattr(sys, name) is None:
                mode = "w" if number else "r"
                stream = open(number, mode, closefd=False)  # noqa: SIM115
                setattr(sys, name, stream)


class Session:
    """The output of one command."""

    def __init__(self, streams: tuple[SafeStream, ...]):
        self._streams = streams
        self._undelivered: OSError | None = None

    def deliver(self, document: str) -> None:
        """Write the result of the command to stdout. The command fails if it is lost.

        Args:
          document: The result.
        """
        say(document)
        self._undelivered = safe("stdout").failure

    def lost(self) -> OSError | None:
        """Return the error due to which output was lost.

        A closed pipe counts only for the result of the command, not for messages, whose
        reader may need only a part of them (`head`).

        Returns:
          The error, or None.
        """
        failures = (stream.failure for stream in self._streams)
        errors = [x for x in failures if x is not None and x.errno != errno.EPIPE]
        return self._undelivered or (errors[0] if errors else None)


_session: Session | None = None


@contextlib.contextmanager
def session() -> Iterator[Session]:
    """Run a command that does not fail because of its messages.

    While the block runs, writing to `sys.stdout` and `sys.stderr` never raises, also in
    other libraries. If the block succeeds although output was lost (because of a full
    disk, or because the reader of the result has ended), the command exits with code 1.

    Yields:
      The session.
    """
    global _session
    if _session is not None:  # another command has called this one
        yield _session
        return
    names = ("stdout", "stderr")
    before = [getattr(sys, name) for name in names]
    streams = tuple(map(safe, names))
    _session = Session(streams)
    try:
        for name, stream in zip(names, streams, strict=True):
            setattr(sys, name, stream)
        try:
            yield _session
        except SystemExit as stop:
            if stop.code not in (None, 0):
                raise
            _exit_if_lost(_session)
            raise
        _exit_if_lost(_session)
    finally:
        _session = None
        for name, stream in zip(names, before, strict=True):
            setattr(sys, name, stream)


def _exit_if_lost(current):
    for stream in current._streams:
        stream.flush()
    problem = current.lost()
    if problem is not None:
        error(f"output was lost: {problem.strerror or problem}")
        raise SystemExit(1)
