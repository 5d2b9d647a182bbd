"""Ctrl-C and SIGTERM as requests that a loop answers when it can."""

import signal
import threading


class StopRequests:
    """While entered, the first SIGINT or SIGTERM is only noted; a second SIGINT raises.

    `name` is the signal's, or None. Outside the main thread, where Python delivers no
    signals, nothing is installed.
    """

    def __init__(self):
        self.name: str | None = None
        self._before: dict[int, object] = {}

    def __enter__(self):
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        return self

    def _note(self, number, _frame):
        if self.name is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.name = signal.Signals(number).name

    def __exit__(self, *_):
        for number, handler in self._before.items():
            signal.signal(number, handler)
