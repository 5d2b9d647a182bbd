"""Budget of preprocessing, in counted work, and the times of its parts.

Work is counted in nominal seconds: pixels, tracks and frames times the rates below. It
is known before a part begins and the same on every machine, whatever its load.
"""

import contextlib
import time
from collections.abc import Callable
from typing import NamedTuple

from nerfies_jax.runtime import events

# Videos of 100 frames of 480x270 take 20 s on one core, and up to a minute and a half
# where most steps are wide.
ENOUGH_WORK = 600.0

# Seconds of one core of a busy two-core server for a million of each, with what was
# measured: 60 frames of 176x132 (the scenes `default` and `fast`), 100 of 480x270.
A_SEARCHED_PIXEL = 1.1  # of flow at its finest level: 1.1 and 1.4
A_TRACK_FRAME = 1.9  # of a start in a frame, chained and realigned: 1.9 and 1.9
A_POINT_FRAME = 0.95  # of a pixel at rest in a frame: 1.0 and 0.9
A_COMPARED_PIXEL = 1.0  # of colors over time: 1.5 and 0.8
A_PATH_FRAME = 15.0  # of a path of least acceleration: 18 and 9
A_BODY_TERM = 5.0  # of a track of a rigid thing times its frames squared: 4.8


class Seconds(NamedTuple):
    """Processor seconds by part."""

    flow: float
    tracks: float
    moving: float
    paths: float
    still: float


# By the fields of `Seconds`, in their order.
PARTS = {
    "flow": "flow between neighbors",
    "tracks": "tracks and the points at rest that explain them best",
    "moving": "what moves",
    "paths": "paths in space",
    "still": "dense points at rest",
}
STAGES = {
    "flow": "optical flow",
    "tracks": "point tracks",
    "moving": "finding what moves",
    "paths": "paths of moving points",
    "still": "dense static points",
}


class Watch:
    """Reports each part, and leaves parts out once a share of the work is spent.

    Only the durations of parts, which are reported, are read from a clock.
    """

    def __init__(self, tell: Callable[[str], None], work: float):
        """`work` is the budget, in nominal seconds."""
        if not work > 0:
            raise ValueError(
                f"work={work} must be positive: what goes beyond it is left out"
            )
        self._tell, self._allowed = tell, work
        self._spent = 0.0
        self._began: dict[str, float] = {}
        self._left_out: dict[str, None] = {}
        self._stage = contextlib.ExitStack()  # of the part that goes on

    def close(self) -> None:
        """End the last part."""
        self._stage.close()

    def begin(self, part: str) -> None:
        """Begin a part.

        Args:
          part: A key of `PARTS`.
        """
        self._began[part] = time.process_time()
        self._tell(PARTS[part])
        self._stage.close()
        self._stage.enter_context(events.stage(STAGES[part]))

    def spend(self, work: float) -> None:
        """Count work that is done in any case.

        Args:
          work: Work in nominal seconds.
        """
        self._spent += work

    def has_room(self, share: float, what: str, work: float) -> bool:
        """Count work unless a share of the budget is spent.

        Args:
          share: Share of the budget.
          what: Name of the part that is left out otherwise.
          work: Work in nominal seconds.

        Returns:
          True if the part is to be done.
        """
        return self.room_for(1, share, what, work) == 1

    def room_for(self, count: int, share: float, what: str, work: float) -> int:
        """Return how many equal pieces begin before a share of the budget is spent.

        They are counted at `work` each.

        Args:
          count: Number of pieces.
          share: Share of the budget.
          what: Name of the part that is otherwise left out in part.
          work: Work of a piece in nominal seconds.

        Returns:
          The number of pieces to be done.
        """
        begun = 0
        while begun < count and self._spent < share * self._allowed:
            self._spent += work
            begun += 1
        if begun < count:
            if what not in self._left_out:
                self._tell(f"left out, beyond the budget of work: {what}")
            self._left_out[what] = None
        return begun

    @property
    def left_out(self) -> str:
        """Names of the parts beyond the budget, empty if there are none."""
        return ", ".join(self._left_out)

    def seconds(self) -> Seconds:
        """Return the processor time of each part so far.

        Returns:
          Seconds by part.
        """
        ends = [*list(self._began.values())[1:], time.process_time()]
        parts = zip(self._began.items(), ends, strict=True)
        return Seconds(**{part: end - began for (part, began), end in parts})
