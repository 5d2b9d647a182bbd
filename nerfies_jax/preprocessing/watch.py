"""Work budget of preprocessing, and the times of its parts.

Work is counted in nominal seconds: pixels, tracks and frames times the rates below. It
is known before a part begins, and does not depend on the machine or its load.
"""

import contextlib
import time
from collections.abc import Callable
from typing import NamedTuple

from nerfies_jax.runtime import events

# Videos of 100 frames of 480x270 take 20 s on one core, and up to a minute and a half
# if most displacements between frames are large.
ENOUGH_WORK = 600.0

# Seconds of one core of a busy two-core server for a million items, followed by the
# measured values: for 60 frames of 176x132 (scenes `default` and `fast`), and for 100
# frames of 480x270.
A_SEARCHED_PIXEL = 1.1  # of flow at its finest level: 1.1 and 1.4
A_TRACK_FRAME = 1.9  # of a start in a frame, chained and realigned: 1.9 and 1.9
A_POINT_FRAME = 0.95  # of a static pixel in a frame: 1.0 and 0.9
A_COMPARED_PIXEL = 1.0  # of colors over time: 1.5 and 0.8
A_PATCH_FRAME = 60.0  # of a moving track, aligned by warped patches: 67 (`default`)
A_PATH_FRAME = 15.0  # of a path of least acceleration: 18 and 9
A_BODY_TERM = 5.0  # of a track of a rigid body times its frames squared: 4.8


class Seconds(NamedTuple):
    """Processor seconds by part."""

    flow: float
    tracks: float
    moving: float
    paths: float
    static: float


# Names for the user, by the fields of `Seconds` in their order.
PARTS = {
    "flow": "optical flow between neighboring frames",
    "tracks": "point tracks and static points",
    "moving": "masks of moving objects",
    "paths": "3D paths",
    "static": "dense static points",
}
STAGES = {
    "flow": "optical flow",
    "tracks": "point tracks",
    "moving": "detecting moving objects",
    "paths": "paths of moving points",
    "static": "dense static points",
}


class Watch:
    """Reports each part, and skips parts after a share of the budget has been spent.

    The clock is used only for the reported durations.

    Args:
      tell: Receives the name of each part, and of skipped parts.
      work: The budget, in nominal seconds.
    """

    def __init__(self, tell: Callable[[str], None], work: float):
        if not work > 0:
            raise ValueError(f"work={work} must be positive")
        self._tell, self._allowed = tell, work
        self._spent = 0.0
        self._began: dict[str, float] = {}
        self._left_out: dict[str, None] = {}
        self._stage = contextlib.ExitStack()  # of the current part

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
        """Count work that is always done.

        Args:
          work: Work in nominal seconds.
        """
        self._spent += work

    def has_room(self, share: float, what: str, work: float) -> bool:
        """Count work unless a share of the budget has been spent.

        Args:
          share: Share of the budget.
          what: Name of the part that is skipped otherwise.
          work: Work in nominal seconds.

        Returns:
          True if the part should be done.
        """
        return self.room_for(1, share, what, work) == 1

    def room_for(self, count: int, share: float, what: str, work: float) -> int:
        """Return the number of equal pieces that fit into a share of the budget.

        The work of these pieces is counted.

        Args:
          count: Number of pieces.
          share: Share of the budget.
          what: Name of the part that is otherwise partially skipped.
          work: Work of a piece in nominal seconds.

        Returns:
          The number of pieces that should be done.
        """
        number = 0
        while number < count and self._spent < share * self._allowed:
            self._spent += work
            number += 1
        if number < count:
            if what not in self._left_out:
                self._tell(f"skipped, beyond the budget of work: {what}")
            self._left_out[what] = None
        return number

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
