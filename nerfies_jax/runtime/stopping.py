"""Graceful shutdown: Ctrl-C, SIGTERM and SIGHUP end a command soon and safely.

Python raises KeyboardInterrupt at any point of the main thread. Inside a callback of
the garbage collector, a `__del__` method or a callback of a weak reference, the
exception is printed and ignored, and the process continues. While compiled code runs,
it is not raised at all. Commands therefore do not rely on exceptions from handlers:

1. `install` turns the first signal into a request, which interrupts nothing.
2. Code checks for requests at points where it can end safely. `check` raises `Stopped`
   there. The training loop finishes its chunk, saves a checkpoint and returns.
3. A thread receives the signal from the C handler through a socket, whatever the main
   thread is doing. If the process has not ended after `GRACE_SECONDS`, the thread runs
   the functions registered with `at_end`, which remove incomplete files, and ends the
   process with exit code 128 + signal. It waits while a `protected` block is open, so
   that saving is never interrupted.
4. A second signal ends the process immediately, as it would without a handler.

A signal that is ignored when the process starts, as SIGHUP is under nohup, stays
ignored. If `install` has not been called, as in a notebook, `check` does nothing, and
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
# A second signal within this time belongs to the same request, because the program
# `timeout` sends its signal to the process and to its group.
SAME_REQUEST_SECONDS = 0.3
POLL_SECONDS = 0.1


class Stopped(SystemExit):
    """Raised at a safe point after a signal. The exit code is 128 + signal."""

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.name = signal.Signals(number).name


class _Process:
    """Requests of this process, after `install`."""

    def __init__(self):
        self.number: int | None = None  # of the first signal
        self.request_time = 0.0
        self.second = False  # whether another signal followed
        self.handled = False  # by `Stopped`, or by a training loop that saves
        self.advice = ""  # line about what the user can do next
        self.protections = 0
        self.unprotected_time = 0.0  # end of the last protected block
        self.lock = threading.Lock()
        self.reader, self.writer = socket.socketpair()
        self.writer.setblocking(False)
        self.before = _install_handler(self._note, NAMES)
        signal.set_wakeup_fd(self.writer.fileno(), warn_on_full_buffer=False)
        self.thread = threading.Thread(target=self._watch, name="signals", daemon=True)
        self.thread.start()

    def _note(self, number, _frame):
        """Handle a signal in the main thread, between two Python instructions."""
        self._request(number)
        if self.second:
            _end_by_default(number)

    def _request(self, number):
        if self.number is None:
            self.request_time, self.number = time.monotonic(), number

    def _watch(self):
        """Receive signals, and end the process when the grace period is over."""
        self.reader.settimeout(POLL_SECONDS)
        first = None
        while True:
            try:
                numbers = self.reader.recv(16)
            except TimeoutError:
                numbers = b""
            except OSError:  # closed as the process ends
                return
            for number in numbers:
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
        """End the process by the signal itself, which needs its main thread."""
        self.second = True
        os.kill(os.getpid(), number)
        time.sleep(POLL_SECONDS)
        os._exit(128 + number)  # the main thread is inside compiled code

    def _is_over(self):
        with self.lock:
            start_time = max(self.request_time, self.unprotected_time)
            duration = time.monotonic() - start_time
            return not self.protections and duration > GRACE_SECONDS

    def _end(self):
        """End the process, whatever the main thread is doing."""
        for clean_up in reversed(_AT_END):
            with contextlib.suppress(Exception):
                clean_up()
        # In another thread, because the main thread may hold the lock of a stream.
        flusher = threading.Thread(target=_flush, daemon=True)
        flusher.start()
        flusher.join(POLL_SECONDS)
        with contextlib.suppress(OSError):
            lines = [] if self.handled else ending(signal.Signals(self.number).name)
            # Show the cursor, which progress bars hide.
            cursor = "\x1b[?25h" if os.isatty(2) else ""
            os.write(2, (cursor + "".join(f"{line}\n" for line in lines)).encode())
        os._exit(128 + self.number)


_PROCESS: _Process | None = None
_AT_END: list[Callable[[], object]] = []
_LOOPS: list["StopRequests"] = []  # open contexts


def _flush():
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()


def _end_by_default(number):
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def install() -> None:
    """Turn signals into requests for the rest of this process.

    It has no effect outside the main thread.
    """
    global _PROCESS
    if _PROCESS is None and threading.current_thread() is threading.main_thread():
        _PROCESS = _Process()


def install_for_program(package: str, script: str) -> None:
    """Call `install` if this process runs `python -m PACKAGE...` or a console script.

    The `__init__` of the package calls this before it imports anything else.

    Args:
      package: Name of the package.
      script: Name of the console script that the package installs.
    """
    words = list(sys.orig_argv)
    # A worker process has the `sys.argv` of its parent.
    if "--multiprocessing-fork" in words:
        return
    index = words.index("-m") + 1 if "-m" in words else 0
    # While Python imports the package of a module, `sys.argv[0]` is "-m".
    by_module = sys.argv[:1] == ["-m"] and words[index].partition(".")[0] == package
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    if by_module or name.removesuffix(".exe") == script:
        install()


@contextlib.contextmanager
def keeps_handlers() -> Iterator[None]:
    """Restore the handler of SIGTERM that an import in this block replaces.

    Unlike `signal.signal`, it works in any thread, and for handlers in C.
    """
    if os.name != "posix":
        yield
        return
    import ctypes

    libc = ctypes.CDLL(None)
    # A `struct sigaction`, which is smaller on every system.
    before = ctypes.create_string_buffer(1024)
    libc.sigaction(int(signal.SIGTERM), None, before)
    try:
        yield
    finally:
        libc.sigaction(int(signal.SIGTERM), before, None)


def check() -> None:
    """Raise `Stopped` if a signal has arrived that has not been handled yet."""
    process = _PROCESS
    if process is None or process.number is None or process.handled:
        return
    if _LOOPS:  # loops check for requests themselves
        return
    if threading.current_thread() is threading.main_thread():
        process.handled = True
        raise Stopped(process.number)


def requested() -> bool:
    """Test if a signal has arrived.

    Returns:
      True if work should end at the next safe point.
    """
    if _PROCESS is not None:
        return _PROCESS.number is not None
    return any(loop.name is not None for loop in _LOOPS)


@contextlib.contextmanager
def protected() -> Iterator[None]:
    """Prevent that the first signal ends the process while the block runs.

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
            process.unprotected_time = time.monotonic()


def at_end(clean_up: Callable[[], object]) -> None:
    """Register a function to call before the process is forcibly ended.

    It runs in another thread while the main thread continues, so it must not wait for
    locks.

    Args:
      clean_up: The function.
    """
    if clean_up not in _AT_END:
        _AT_END.append(clean_up)


def advise(line: str) -> None:
    """Set the line that is printed when a signal ends the process.

    Args:
      line: The line, or "" for none.
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
    """Lets a loop handle signals: the first one is recorded, and the loop returns.

    After `install`, a second signal ends the process. Otherwise a second SIGINT raises
    KeyboardInterrupt. Ignored signals stay ignored. Outside the main thread, to which
    Python delivers signals, no handlers are installed.
    """

    def __init__(self):
        self._name: str | None = None
        self._before: dict[int, object] = {}
        self._protection = contextlib.ExitStack()
        self._is_protected = False

    def __enter__(self):
        if _PROCESS is None:
            self._before = _install_handler(self._note, NAMES)
        _LOOPS.append(self)
        return self

    @property
    def name(self) -> str | None:
        """Name of the signal, or None. A loop that reads a name must return."""
        main = threading.current_thread() is threading.main_thread()
        process = _PROCESS
        if main and self._name is None and process is not None and process.number:
            process.handled = True
            self._name = signal.Signals(process.number).name
        return self._name

    def protect(self) -> None:
        """Prevent that signals end the process before the block ends and has saved."""
        if not self._is_protected:
            self._is_protected = True
            self._protection.enter_context(protected())

    def _note(self, number, _frame):
        if self._name is not None and number == signal.SIGINT:
            raise KeyboardInterrupt("interrupted twice, nothing was saved")
        self._name = signal.Signals(number).name

    def __exit__(self, *_):
        _LOOPS.remove(self)
        self._protection.close()
        _restore(self._before)


@contextlib.contextmanager
def exits() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise SystemExit with code 128 + signal in the block.

    For code that is called without `install`. The next signal of the same kind ends the
    process.

    Yields:
      None.
    """
    if _PROCESS is not None:
        yield
        return

    def leave(number, _frame):
        signal.signal(number, signal.SIG_DFL)
        raise SystemExit(128 + number)

    before = _install_handler(leave, NAMES[1:])
    try:
        yield
    finally:
        _restore(before)


def _install_handler(handler, names):
    """Install a handler for signals, and return the earlier ones by number."""
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
