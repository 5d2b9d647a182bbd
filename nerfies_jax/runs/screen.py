"""Pictures of a run for who looks around in it: any view, effects on or off."""

import time
from typing import Any

import numpy as np

from nerfies_jax.capture import camera_paths
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation import Renderer, interactive, model_flow
from nerfies_jax.evaluation.interactive import Eye, Look
from nerfies_jax.evaluation.pictures import Coloured
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.runs.run import Run
from nerfies_jax.training.model import TrainState, View, in_default_precision


class Screen:
    """Draws a run's trained state in pictures of a few sizes, `sizes`, coarsest first.

    Each combination of size and effects is compiled when it is first looked at.
    """

    def __init__(self, run: Run, full: tuple[int, int]):
        self.run, self.sizes = run, interactive.ladder(full)
        settings = run.spec, run.metadata
        self.parts = run.representation.parts(*settings, effects=run.effects)
        self._move = run.representation.mover(*settings, effects=run.effects)
        self._renderers: dict[Any, Renderer] = {}
        self._seconds: dict[Any, float] = {}
        # Rounding must not be drawn as motion: what moves by less than a pixel does not
        # reach full colour.
        self._limits = {"motion": (0.0, _pixel_length(run.capture))}

    @property
    def channels(self) -> tuple[str, ...]:
        """Those that there are: motion only where something moves points."""
        still = self._move is None
        return tuple(c for c in interactive.CHANNELS if not (still and c == "motion"))

    def seconds(self, look: Look) -> list[float | None]:
        """What the last picture of each size took, without compiling; None: no one."""
        return [
            self._seconds.get((look.without, look.channel, size)) for size in self.sizes
        ]

    def draw(self, state: TrainState, eye: Eye, look: Look, rung: int) -> np.ndarray:
        """The picture [height, width, 3] uint8 of the size at `rung`.

        Depth is coloured over the range of the first picture that has any, motion over
        the farthest so far.
        """
        size = self.sizes[rung]
        key = look.without, look.channel, size
        began, first = time.perf_counter(), key not in self._seconds
        renderer = self._renderer(look.without, size)
        view = in_default_precision(
            View(
                interactive.camera_of(eye, size),
                np.float32(look.time),
                np.int32(look.appearance),
            )
        )
        rendering = renderer(state, view)
        distance = None
        if look.channel == "motion":
            start = view._replace(time=in_default_precision(np.float32(0)))
            distance = model_flow.picture_distance(
                self._move, state, view, start, rendering
            )
        limits = self._limits.get(look.channel)
        drawn = interactive.as_channel(look.channel, rendering, distance, limits)
        self._keep_limits(look.channel, drawn)
        # The first may have been compiled, which the renderer leaves out.
        elapsed = time.perf_counter() - began
        self._seconds[key] = renderer.seconds[-1] if first else elapsed
        return drawn.picture

    def legend(self, channel: str) -> str:
        """What the colours of a channel stand for; empty where they need no words."""
        low, high = self._limits.get(channel, (0.0, 0.0))
        if channel == "depth":
            return f"bright {low:.3g}, dark {high:.3g} scene units away"
        if channel == "motion":
            return f"since time 0: black none, light yellow {high:.3g} scene units"
        return ""

    def _keep_limits(self, channel: str, drawn: Coloured) -> None:
        # Motion since time 0 grows with the time, depth is much the same everywhere.
        if channel == "motion":
            self._limits[channel] = drawn.low, drawn.high
        elif channel == "depth" and drawn.high > drawn.low:
            self._limits.setdefault(channel, (drawn.low, drawn.high))

    def _renderer(self, without, size):
        if (without, size) not in self._renderers:
            run, model = self.run, self.run.model
            if without:
                model = run.representation.variant(
                    run.spec, run.metadata, without, False, effects=run.effects
                )
            self._renderers[without, size] = Renderer(model, size)
        return self._renderers[without, size]


def _pixel_length(capture: Capture) -> float:
    """How long a pixel is at what the training cameras look at, scene units."""
    train = cameras.take(capture.cameras, capture.train)
    focus = camera_paths.focus_point(train, capture.near, capture.far)
    away = np.linalg.norm(train.position - focus, axis=-1)
    return float(np.median(away / train.focal_px))
