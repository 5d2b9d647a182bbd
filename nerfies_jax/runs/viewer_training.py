"""Panel of the viewer for a run in training: loss curve and pause button."""

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

MAX_POINTS = 1000  # of the curve. If there are more, every second one is removed.
ABSENT_SECONDS = 10.0  # without a browser until paused training continues
PLOT_PX = 180
_LOSS = "loss"


class TrainingPanel:
    """The loss curve and the pause button of training.

    Args:
      server: The server of viser.
      deferred: As for `viewer_path.PathPanel`.
      pausable: True if training is in progress, so that it can be paused.
    """

    def __init__(self, server: Any, deferred: Callable, pausable: bool):
        self.paused = False
        self._server = server
        self._steps: list[float] = []
        self._losses: list[float] = []
        self._stride, self._skipped = 1, 0
        self._plot = self._button = None
        self._connected_time = time.monotonic()  # when a browser was last connected
        self._folder = server.gui.add_folder("training", visible=pausable)
        if pausable:
            with self._folder:
                self._button = server.gui.add_button("pause training", color="gray")
                self._button.on_click(deferred(lambda *_: self._pause(not self.paused)))

    def add(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a point to the curve.

        Args:
          step: The step.
          metrics: Metrics by name. Those without a positive, finite loss are ignored.
        """
        loss = float(metrics.get(_LOSS, math.nan))
        # The axis is logarithmic.
        if not (0 < loss < math.inf):
            return
        self._skipped += 1
        if self._skipped < self._stride:
            return
        self._skipped = 0
        self._steps.append(float(step))
        self._losses.append(loss)
        if len(self._steps) > MAX_POINTS:
            del self._steps[1::2], self._losses[1::2]
            self._stride *= 2

    def show(self) -> None:
        """Send the curve to the browsers."""
        if len(self._steps) < 2:
            return
        data = np.asarray(self._steps), np.asarray(self._losses)
        if self._plot is not None:
            self._plot.data = data
            return
        self._folder.visible = True
        with self._folder:
            self._plot = self._server.gui.add_uplot(
                data,
                ({"label": "step"}, {"label": _LOSS, "stroke": "#228be6", "width": 2}),
                scales={"x": {"time": False}, "y": {"distr": 3}},
                title="training loss",
                height=PLOT_PX,
            )

    def is_paused(self, browsers: int) -> bool:
        """Test if training must wait.

        A pause ends automatically if no browser is connected for `ABSENT_SECONDS`.

        Args:
          browsers: Number of connected browsers.

        Returns:
          True while training is paused.
        """
        now = time.monotonic()
        if browsers:
            self._connected_time = now
        if self.paused and now - self._connected_time > ABSENT_SECONDS:
            self._pause(False)
        return self.paused

    def _pause(self, is_paused):
        self.paused = is_paused
        self._connected_time = time.monotonic()
        if self._button is not None:
            self._button.label = "resume training" if is_paused else "pause training"
