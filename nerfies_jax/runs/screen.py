"""Images of a run for an interactive viewer, with effects enabled or disabled."""

import collections
import statistics
import time
from typing import Any

import numpy as np

from nerfies_jax.capture import camera_paths
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation import Renderer, interactive, model_flow
from nerfies_jax.evaluation.interactive import Eye, Look
from nerfies_jax.evaluation.representation import SplatCloud, Splatting
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.runs.run import Run
from nerfies_jax.training.model import Model, TrainState, View, in_default_precision
from nerfies_jax.visualization.panels import Colored

# Pixels of a tile. A tile must be rendered before a new view can be shown. The time of
# ray tracing is proportional to the pixels, while a rasterizer processes all Gaussians
# for every tile.
TRACED_PIXELS, RASTERIZED_PIXELS = 2048, 65536
TIMED_TILES = 5  # whose median time predicts the time of the next one


class Screen:
    """Renders the trained state of a run in tiles, level by level of an image pyramid.

    Each combination of effects is compiled when it is viewed for the first time.

    Args:
      run: The run.
      full: Width and height in pixels of the finest level.
    """

    def __init__(self, run: Run, full: tuple[int, int]):
        self.run = run
        is_traced = run.model.stages is None
        pixels = TRACED_PIXELS if is_traced else RASTERIZED_PIXELS
        self.pyramid = interactive.pyramid(full, pixels)
        settings = run.spec, run.metadata
        self.parts = run.representation.products.parts(*settings)
        self._move = run.representation.scoring.mover(*settings)
        self._models: dict[tuple[str, ...], Model] = {}
        self._renderers: dict[tuple[str, ...], Renderer] = {}
        self._splatting: dict[tuple[str, ...], Splatting] = {}
        self._seconds: dict[Any, collections.deque] = {}
        # Initially the color range of motion ends at the length of one pixel, so that
        # rounding errors are not shown as motion.
        self._limits = {"motion": (0.0, _pixel_length(run.capture))}

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that can be shown: "motion" only if the model moves points."""
        static = self._move is None
        return tuple(c for c in interactive.CHANNELS if not (static and c == "motion"))

    @property
    def in_browser(self) -> bool:
        """True if browsers can render the colors of this run themselves."""
        return self.run.representation.products.splatting is not None

    def is_compiled(self, look: Look) -> bool:
        """Test if the program for a channel and variant has been used before.

        Args:
          look: The requested channel and variant.

        Returns:
          True if rendering needs no compilation.
        """
        in_browser = self.in_browser and look.channel == "color"
        return look.without in (self._splatting if in_browser else self._renderers)

    def splats(self, state: TrainState, eye: Eye, look: Look) -> SplatCloud:
        """Return the Gaussians of a run, for the rasterizer of a browser.

        The run must be `in_browser`.

        Args:
          state: Trained state.
          eye: Viewpoint.
          look: Requested time, appearance and variant.

        Returns:
          The Gaussians.
        """
        if look.without not in self._splatting:
            run, splatting = self.run, self.run.representation.products.splatting
            assert splatting is not None  # `in_browser`
            self._splatting[look.without] = splatting(
                run.spec, run.metadata, look.without
            )
        evaluate = self._splatting[look.without]
        return evaluate(state, look.time, look.appearance, np.asarray(eye.position))

    def tile_seconds(self, look: Look) -> float | None:
        """Return the time to render a tile, without compilation.

        Args:
          look: The requested channel and variant.

        Returns:
          Median seconds, or None before the first tile.
        """
        seconds = self._seconds.get((look.without, look.channel))
        return None if seconds is None else statistics.median(seconds)

    def draw(
        self, state: TrainState, eye: Eye, look: Look, level: int, cell: tuple[int, int]
    ) -> np.ndarray:
        """Render one tile of a level.

        The color range of depth is that of the first coarsest image with more than one
        depth. The color range of motion ends at the largest distance in all coarsest
        images so far.

        Args:
          state: Trained state.
          eye: Viewpoint.
          look: Requested time, channel and variant.
          level: Level of the pyramid.
          cell: Column and row of the tile.

        Returns:
          uint8 image, [height, width, 3].
        """
        start_time, key = time.perf_counter(), (look.without, look.channel)
        renderer = self._renderer(look.without)
        camera = interactive.camera_of(eye, self.pyramid.size(level))
        camera = interactive.tile_camera(camera, self.pyramid, cell)
        leaves = camera, np.float32(look.time), np.int32(look.appearance)
        view = in_default_precision(View._make(leaves))
        rendering = renderer(state, view)
        limits = self._limits.get(look.channel)
        distance = None
        if look.channel == "motion" and self._move is not None:
            start = view._replace(time=in_default_precision(np.float32(0)))
            distance = model_flow.image_distance(
                self._move, state, view, start, rendering
            )
            if level and limits is not None:
                # All tiles need the same color range.
                distance = np.minimum(distance, limits[1])
        image = interactive.as_channel(look.channel, rendering, distance, limits)
        if not level:
            self._keep_limits(look.channel, image)
        # The first call may include compilation, which `renderer.seconds` excludes.
        first = key not in self._seconds
        duration = renderer.seconds[-1] if first else time.perf_counter() - start_time
        recent = self._seconds.setdefault(key, collections.deque(maxlen=TIMED_TILES))
        recent.append(duration)
        return image.image

    def model(self, without: tuple[str, ...]) -> Model:
        """Return the model with some effects disabled.

        Args:
          without: Names of the disabled effects.

        Returns:
          The model.
        """
        if without not in self._models:
            run, model = self.run, self.run.model
            if without:
                model = run.representation.products.variant(
                    run.spec, run.metadata, without, False
                )
            self._models[without] = model
        return self._models[without]

    def legend(self, channel: str) -> str:
        """Explain the colors of a channel.

        Args:
          channel: Name of the channel.

        Returns:
          The text, empty if the colors need no explanation.
        """
        low, high = self._limits.get(channel, (0.0, 0.0))
        if channel == "depth":
            return f"depth: bright {low:.3g}, dark {high:.3g} scene units"
        if channel == "motion":
            return f"motion since time 0: black 0, light yellow {high:.3g} scene units"
        return ""

    def _keep_limits(self, channel: str, image: Colored) -> None:
        # The range of motion since time 0 grows with time, that of depth hardly does.
        if channel == "motion":
            self._limits[channel] = image.low, image.high
        elif channel == "depth" and image.high > image.low:
            self._limits.setdefault(channel, (image.low, image.high))

    def _renderer(self, without):
        if without not in self._renderers:
            model = self.model(without)
            self._renderers[without] = Renderer(model, self.pyramid.tile)
        return self._renderers[without]


def _pixel_length(capture: Capture) -> float:
    """Length of a pixel at the focus point of the cameras, in scene units."""
    train = cameras.take(capture.cameras, capture.train)
    focus = camera_paths.focus_point(train, capture.near, capture.far)
    distance = np.linalg.norm(train.position - focus, axis=-1)
    return float(np.median(distance / train.focal_px))
