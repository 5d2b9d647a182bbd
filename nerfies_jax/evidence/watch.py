"""How long the parts of gathering evidence take, and what there is no time for."""

import contextlib
import time
from collections.abc import Callable
from typing import NamedTuple

from nerfies_jax import events

# Films of 100 frames of 480x270 take 20 s on one core, and up to a minute and a half
# where most steps are wide.
ENOUGH_SECONDS = 600.0


class Seconds(NamedTuple):
    """Of the processor, by part."""

    flow: float
    tracks: float
    moving: float
    paths: float
    still: float


PARTS = Seconds(
    "flow between neighbours",
    "tracks and the points at rest that explain them best",
    "what moves",
    "paths in space",
    "dense points at rest",
)


STAGES = {
    "flow": "optical flow",
    "tracks": "point tracks",
    "moving": "finding what moves",
    "paths": "paths of moving points",
    "still": "dense static points",
}


class Watch:
    """Says which part begins, and what is left out once a share of the time is gone."""

    def __init__(self, tell: Callable[[str], None], seconds: float):
        if not seconds > 0:
            raise ValueError(
                f"seconds={seconds} must be positive: what takes longer is left out"
            )
        self._tell, self._allowed = tell, seconds
        self._start = time.perf_counter()
        self._began: dict[str, float] = {}
        self._left_out: dict[str, None] = {}
        self._stage = contextlib.ExitStack()  # of the part that goes on

    def close(self) -> None:
        """End the last part."""
        self._stage.close()

    def begin(self, part: str) -> None:
        """A field of `PARTS`."""
        self._began[part] = time.process_time()
        self._tell(getattr(PARTS, part))
        self._stage.close()
        self._stage.enter_context(events.stage(STAGES[part]))

    def has_time(self, share: float, what: str) -> bool:
        """Whether less than a share of the time is gone; else `what` is left out."""
        if time.perf_counter() - self._start < share * self._allowed:
            return True
        if what not in self._left_out:
            self._tell(f"no time for {what}")
        self._left_out[what] = None
        return False

    @property
    def left_out(self) -> str:
        """Words for all that there was no time for; empty where there was enough."""
        return ", ".join(self._left_out)

    def seconds(self) -> Seconds:
        """From the beginning of each part to that of the next, and to now."""
        ends = [*list(self._began.values())[1:], time.process_time()]
        parts = zip(self._began.items(), ends, strict=True)
        return Seconds(**{part: end - began for (part, began), end in parts})
