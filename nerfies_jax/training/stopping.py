"""Ctrl-C, SIGTERM and SIGHUP as requests that a loop answers when it can."""

import signal
import threading

NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP


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
        if threading.current_thread() is threading.main_thread():
            for name in NAMES:
                number = getattr(signal, name, None)
                if number is None or signal.getsignal(number) == signal.SIG_IGN:
                    continue
                self._before[number] = signal.signal(number, self._note)
        return self

    def _note(self, number, _frame):
        if self.name is not None and number == signal.SIGINT:
            raise KeyboardInterrupt("interrupted a second time, without saving")
        self.name = signal.Signals(number).name

    def __exit__(self, *_):
        for number, handler in self._before.items():
            signal.signal(number, handler)
