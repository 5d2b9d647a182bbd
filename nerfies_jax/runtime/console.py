"""Messages to the user, which never end or skip the work that they report.

Every message of the packages goes through `say`, `note`, `warn` and `error`. A reader
that went away (`reconstruct ... | head`), a full disk under a log file and a closed
stream lose the message and nothing else: the first error is remembered, the descriptor
is pointed at the null device, and the work goes on. A `session` does the same for what
other libraries write, and decides the exit code of a command.
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
        # One write: lines of several processes in one log stay whole.
        stream.write(text + "\n")


@contextlib.contextmanager
def display(above: Callable[[str], None]) -> Iterator[None]:
    """Send lines for a terminal to `above` while the block runs.

    Args:
      above: Writes a line above the progress display that occupies the last lines.

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
    """A text stream whose `write` and `flush` never raise an error of its file.

    Attributes:
      failure: The first error, or None while everything has been written.
    """

    def __init__(self, stream: Any):
        self._stream = stream
        self.failure: OSError | None = None

    def write(self, text: str) -> int:
        """Write and flush at the end of a line, since a pipe must not hold lines back.

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
            coding = self._stream.encoding
            plain = text.encode(coding, "backslashreplace").decode(coding)
            self._stream.write(plain)

    def writelines(self, lines) -> None:
        """Write every line.

        Args:
          lines: The lines.
        """
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush what was written."""
        self._attempt(lambda: self._stream.flush())

    def isatty(self) -> bool:
        """Return whether this is a terminal.

        Returns:
          True for a terminal.
        """
        try:
            return self._stream is not None and self._stream.isatty()
        except ValueError:  # closed
            return False

    def _attempt(self, action, *arguments):
        if self._stream is None:  # Python opens none for a closed descriptor
            return
        try:
            action(*arguments)
        except BlockingIOError:
            pass  # a slow reader: it is still in the buffer, for the next flush
        except RuntimeError:
            pass  # a signal handler that writes in the middle of a write
        except (OSError, ValueError) as problem:
            lost = problem if isinstance(problem, OSError) else OSError(str(problem))
            self._give_up(lost)

    def _give_up(self, problem):
        self.failure = self.failure or problem
        # The rest of the buffer goes there too: otherwise Python would fail on it again
        # when it exits, with code 120.
        with contextlib.suppress(OSError, ValueError):
            _point_at_null(self._stream.fileno())
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def safe(name: str) -> SafeStream:
    """Return `sys.stdout` or `sys.stderr`, by its name, as a stream that never raises.

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

    Otherwise the next file that is opened gets the number of the stream, and native
    libraries write their standard error into the middle of it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # The lowest free number, which is this one.
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
        """Write the result of the command to stdout. If it is lost, the command fails.

        Args:
          document: The result.
        """
        say(document)
        self._undelivered = safe("stdout").failure

    def lost(self) -> OSError | None:
        """Return why output was lost.

        A reader of messages that has read enough, such as `head`, is no loss. A reader
        of a document that went away before its end is one.

        Returns:
          The error, or None.
        """
        failures = (stream.failure for stream in self._streams)
        unread = [x for x in failures if x is not None and x.errno != errno.EPIPE]
        return self._undelivered or (unread[0] if unread else None)


_session: Session | None = None


@contextlib.contextmanager
def session() -> Iterator[Session]:
    """Run a command whose output cannot end it.

    While the block runs, writing to `sys.stdout` and `sys.stderr` never raises,
    whichever library writes. If the block succeeds although output was lost (a full
    disk, a document whose reader went away), the command exits with code 1.

    Yields:
      The session.
    """
    global _session
    if _session is not None:  # of the command that called this one
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
