"""Ctrl-C, SIGTERM and SIGHUP end a command soon and in good order.

Python raises KeyboardInterrupt wherever the main thread happens to be. Inside a
callback of the garbage collector, a `__del__` method or a weak reference's callback,
such an exception is printed and dropped, and the process goes on. While compiled code
runs, it is not raised at all. Commands therefore do not rely on exceptions from
handlers:

1. `install` turns the first signal into a request. Nothing is interrupted by it.
2. Code that can end in good order looks for the request at a safe point. `check` raises
   `Stopped` there, and the training loop finishes its chunk, saves and returns.
3. A thread learns of the signal from the C handler through a socket, whatever the main
   thread is doing. If the process has not ended after `GRACE_SECONDS`, the thread runs
   the functions registered with `at_end`, which remove what is half written, and ends
   the process with exit code 128 + signal. It waits while a `protected` block is open,
   so a save is never cut off.
4. A second signal ends the process at once, as it would without a handler.

A signal that is ignored when the process starts, as SIGHUP is under nohup, stays
ignored. Where `install` was not called, as in a notebook, `check` does nothing, and
signals are handled only inside `StopRequests` and `exits`.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator

NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP
GRACE_SECONDS = 2.0  # from a request to the forced end
# `timeout` sends its signal to the process and to its group: one request, twice.
SAME_REQUEST_SECONDS = 0.3
POLL_SECONDS = 0.1


class Stopped(SystemExit):
    """Raised at a safe point after a signal. The exit code is 128 + signal."""

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.name = signal.Signals(number).name


class _Process:
    """The requests of this process, once `install` was called."""

    def __init__(self):
        self.number: int | None = None  # of the first signal
        self.requested_at = 0.0
        self.second = False  # whether another one followed
        self.answered = False  # by `Stopped`, or by a training loop that saved
        self.advice = ""  # what a person may do next
        self.protections = 0
        self.unprotected_at = 0.0
        self.lock = threading.Lock()
        self.reader, self.writer = socket.socketpair()
        self.writer.setblocking(False)
        self.before = _installed(self._note, NAMES)
        self.wakeup_before = signal.set_wakeup_fd(
            self.writer.fileno(), warn_on_full_buffer=False
        )
        self.thread = threading.Thread(target=self._watch, name="signals", daemon=True)
        self.thread.start()

    def _note(self, number, _frame):
        """Handle a signal in the main thread, between two operations of Python."""
        self._request(number)
        if self.second:
            _end_by_default(number)

    def _request(self, number):
        if self.number is None:
            self.requested_at, self.number = time.monotonic(), number

    def _watch(self):
        """Read the signals as they arrive and end the process when time is up."""
        self.reader.settimeout(POLL_SECONDS)
        first = None
        while True:
            try:
                received = self.reader.recv(16)
            except TimeoutError:
                received = b""
            except OSError:  # closed by `uninstall`
                return
            for number in received:
                if number not in self.before:
                    continue
                self._request(number)
                if first is None:
                    first = time.monotonic()
                elif time.monotonic() - first > SAME_REQUEST_SECONDS:
                    self._end_at_once(number)
            if self.number is not None and self._is_over():
                self._end()

    def _end_at_once(self, number):
        """End the process by the signal itself, which only its main thread can do."""
        self.second = True
        os.kill(os.getpid(), number)
        time.sleep(POLL_SECONDS)
        os._exit(128 + number)  # the main thread is inside compiled code

    def _is_over(self):
        with self.lock:
            begun = max(self.requested_at, self.unprotected_at)
            return not self.protections and time.monotonic() - begun > GRACE_SECONDS

    def _end(self):
        """End the process wherever the main thread is."""
        for clean_up in reversed(_AT_END):
            with contextlib.suppress(Exception):
                clean_up()
        # The main thread may hold the lock of a stream.
        flusher = threading.Thread(target=_flush, daemon=True)
        flusher.start()
        flusher.join(POLL_SECONDS)
        with contextlib.suppress(OSError):
            lines = [] if self.answered else ending(signal.Signals(self.number).name)
            # A progress display hides the cursor of a terminal.
            shown = "\x1b[?25h" if os.isatty(2) else ""
            os.write(2, (shown + "".join(f"{line}\n" for line in lines)).encode())
        os._exit(128 + self.number)


_PROCESS: _Process | None = None
_AT_END: list[Callable[[], object]] = []
_LOOPS: list["StopRequests"] = []  # that are open


def _flush():
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()


def _end_by_default(number):
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def install() -> None:
    """Make signals requests for the rest of this process, from its main thread."""
    global _PROCESS
    if _PROCESS is None and threading.current_thread() is threading.main_thread():
        _PROCESS = _Process()


def uninstall() -> None:
    """Restore the handlers that `install` replaced."""
    global _PROCESS
    process, _PROCESS = _PROCESS, None
    if process is not None:
        signal.set_wakeup_fd(process.wakeup_before)
        _restore(process.before)
        process.reader.close()
        process.writer.close()


def install_for_program(package: str, script: str) -> None:
    """Call `install` if this process runs `python -m PACKAGE...` or a console script.

    The package calls this in its `__init__`, before anything else is imported.

    Args:
      package: Name of the package.
      script: Name of the console script that the package installs.
    """
    words = list(sys.orig_argv)
    if "--multiprocessing-fork" in words:  # a worker of a program, with its `sys.argv`
        return
    at = words.index("-m") + 1 if "-m" in words else 0
    # Until a module is found, `sys.argv[0]` is "-m".
    by_module = sys.argv[:1] == ["-m"] and words[at].partition(".")[0] == package
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    if by_module or name.removesuffix(".exe") == script:
        install()


def is_installed() -> bool:
    """Return whether signals are requests in this process.

    Returns:
      True after `install`.
    """
    return _PROCESS is not None


def check() -> None:
    """Raise `Stopped` if a signal has arrived and nothing has answered it yet."""
    process = _PROCESS
    if process is None or process.number is None or process.answered:
        return
    if _LOOPS:  # which look for requests themselves
        return
    if threading.current_thread() is threading.main_thread():
        process.answered = True
        raise Stopped(process.number)


def requested() -> bool:
    """Return whether a signal has arrived that a loop or a safe point is to answer.

    Returns:
      True if one has.
    """
    if _PROCESS is not None:
        return _PROCESS.number is not None
    return any(loop.name is not None for loop in _LOOPS)


@contextlib.contextmanager
def protected() -> Iterator[None]:
    """Keep the process from being ended by the first signal while the block runs.

    Yields:
      None.
    """
    process = _PROCESS
    if process is None:
        yield
        return
    with process.lock:
        process.protections += 1
    try:
        yield
    finally:
        with process.lock:
            process.protections -= 1
            process.unprotected_at = time.monotonic()


def at_end(clean_up: Callable[[], object]) -> None:
    """Register a function to call before the process is ended by force.

    It runs in another thread while the main thread goes on, so it must not wait for
    locks.

    Args:
      clean_up: The function.
    """
    if clean_up not in _AT_END:
        _AT_END.append(clean_up)


def advise(line: str) -> None:
    """Set the line that is printed when a signal ends the process.

    Args:
      line: The line, "" for none.
    """
    if _PROCESS is not None:
        _PROCESS.advice = line


def ending(name: str) -> list[str]:
    """Return the lines to print when a signal ends a command.

    Args:
      name: Name of the signal.

    Returns:
      The lines.
    """
    lines = ["interrupted" if name == "SIGINT" else f"stopped by {name}"]
    if _PROCESS is not None and _PROCESS.advice:
        lines.append(_PROCESS.advice)
    return lines


class StopRequests:
    """Lets a loop answer signals: the first is only noted, and the loop then returns.

    After `install`, a second signal ends the process. Elsewhere a second SIGINT raises
    KeyboardInterrupt. A signal that was ignored stays ignored. Outside the main thread,
    where Python delivers no signals, nothing is installed.
    """

    def __init__(self):
        self._name: str | None = None
        self._before: dict[int, object] = {}
        self._protection = contextlib.ExitStack()
        self._is_protected = False

    def __enter__(self):
        if _PROCESS is None:
            self._before = _installed(self._note, NAMES)
        _LOOPS.append(self)
        return self

    @property
    def name(self) -> str | None:
        """The signal's name, or None. A loop that reads a name must return."""
        main = threading.current_thread() is threading.main_thread()
        process = _PROCESS
        if main and self._name is None and process is not None and process.number:
            process.answered = True
            self._name = signal.Signals(process.number).name
        return self._name

    def protect(self) -> None:
        """Keep the process alive until the block ends: there is something to save."""
        if not self._is_protected:
            self._is_protected = True
            self._protection.enter_context(protected())

    def _note(self, number, _frame):
        if self._name is not None and number == signal.SIGINT:
            raise KeyboardInterrupt("interrupted a second time, without saving")
        self._name = signal.Signals(number).name

    def __exit__(self, *_):
        _LOOPS.remove(self)
        self._protection.close()
        _restore(self._before)


@contextlib.contextmanager
def exits() -> Iterator[None]:
    """End the block by SIGTERM and SIGHUP as by Ctrl-C, with exit code 128 + signal.

    For code that is called without `install`. The next signal of the same kind ends the
    process.

    Yields:
      None.
    """
    if is_installed():
        yield
        return

    def leave(number, _frame):
        signal.signal(number, signal.SIG_DFL)
        raise SystemExit(128 + number)

    before = _installed(leave, NAMES[1:])
    try:
        yield
    finally:
        _restore(before)


def _installed(handler, names):
    """Install a handler, and return the earlier ones by number."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in names:
            number = getattr(signal, name, None)
            if number is None or signal.getsignal(number) == signal.SIG_IGN:
                continue
            before[number] = signal.signal(number, handler)
    return before


def _restore(before):
    for number, handler in before.items():
        signal.signal(number, handler)
