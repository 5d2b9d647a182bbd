"""Ctrl-C, SIGTERM and SIGHUP as requests that a loop answers when it can."""

import contextlib
import signal
import threading
from collections.abc import Iterator

NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP


_ACTIVE: list["StopRequests"] = []


def requested() -> bool:
    """Return whether a signal has arrived that a loop is to answer."""
    return any(each.name is not None for each in _ACTIVE)


class StopRequests:
    """While entered, the first signal is only noted; a second SIGINT raises.

    `name` is the signal's, or None. A signal that was to be ignored, as SIGHUP is under
    nohup, still is. Outside the main thread, where Python delivers no signals, nothing
    is installed.
    """

    def __init__(self):
        self.name: str | None = None
        self._before: dict[int, object] = {}

    def __enter__(self):
        self._before = _installed(self._note, NAMES)
        _ACTIVE.append(self)
        return self

    def _note(self, number, _frame):
        if self.name is not None and number == signal.SIGINT:
            raise KeyboardInterrupt("interrupted a second time, without saving")
        self.name = signal.Signals(number).name

    def __exit__(self, *_):
        _ACTIVE.remove(self)
        _restore(self._before)


@contextlib.contextmanager
def exits() -> Iterator[None]:
    """SIGTERM and SIGHUP leave the block as Ctrl-C does, with exit code 128 + number.

    What was begun in it, folders that are half written and processes, is cleared away
    on the way out. The next one of the same kind ends the process at once.
    """

    def leave(number, _frame):
        signal.signal(number, signal.SIG_DFL)
        raise SystemExit(128 + number)

    before = _installed(leave, NAMES[1:])
    try:
        yield
    finally:
        _restore(before)


def _installed(handler, names):
    """What handled these signals before, by number, where `handler` does now."""
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
