"""What holds of the events of every run."""

import contextlib
import threading
import traceback
from collections.abc import Iterator, Sequence

import jax

from nerfies_jax.runtime import events
from tests.budget import COMPILED


def ended_stages(written: Sequence[dict]) -> list[str]:
    """Names of stages in the order in which they began; each begins and ends once."""
    numbers = [one["stage"] for one in written if one["kind"] == "stage"]
    names = []
    for number in dict.fromkeys(numbers):
        mine = [one for one in written if one.get("stage") == number]
        first, *between, last = [one["status"] for one in mine]
        assert first == "begin", mine
        assert set(between) <= {"progress"}, mine
        assert last == "done", mine
        assert mine[-1]["seconds"] >= 0
        names.append(mine[0]["name"])
    return names


@contextlib.contextmanager
def programs_in_stages() -> Iterator[None]:
    """Check that the thread compiles programs within stages only."""
    thread, outside = threading.get_ident(), []

    def listen(event, _seconds, **_):
        is_here = event == COMPILED and threading.get_ident() == thread
        if is_here and not events.open_stages():
            outside.append("".join(traceback.format_stack()))

    jax.clear_caches()  # else it depends on the tests before
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not outside, outside[0]
