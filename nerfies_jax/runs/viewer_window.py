"""Scene in one browser: Gaussians that the browser renders, or images rendered here."""

import contextlib
import time
from collections.abc import Callable

import numpy as np

from nerfies_jax.evaluation import interactive, to_uint8
from nerfies_jax.evaluation.interactive import Eye, Look
from nerfies_jax.evaluation.representation import SplatCloud
from nerfies_jax.runs.screen import Screen
from nerfies_jax.training.model import TrainState

IDLE_SECONDS = 0.01
STATIC_SECONDS = 0.2  # without a change until a view is considered static
REFRESH_SECONDS = 2.0  # between two updates of a static view during training
PARTIAL_SECONDS = 0.15  # between two images of an incomplete level
SPLATS_SECONDS = 1 / 30  # between two updates of the Gaussians
CAMERA_SECONDS = 0.2  # the same, if only the camera has moved
BYTES_PER_SECOND = 40e6  # of Gaussians that a browser can unpack and sort
BYTES_PER_SPLAT = 32
JPEG_QUALITY = 90
LARGEST_HALF = 6e4  # below the largest float16
COMPILING = "Compiling the renderer for the first image ..."
_NAME = "/splats"


def eye_of(camera) -> Eye | None:
    """Convert viser's camera.

    Args:
      camera: Camera of a browser.

    Returns:
      The viewpoint, or None until the browser has reported one.
    """
    if camera.update_timestamp == 0 or not camera.image_height:
        return None
    return Eye(
        quaternion=tuple(np.asarray(camera.wxyz, np.float64).tolist()),
        position=tuple(np.asarray(camera.position, np.float64).tolist()),
        fov_rad=float(camera.fov),
        aspect=float(camera.image_width / camera.image_height),
    )


@contextlib.contextmanager
def departing(client):
    """Suppress warnings of viser about messages to a browser that has disconnected.

    Browsers may disconnect at any time. Only messages sent in this block are affected.

    Args:
      client: The browser.

    Yields:
      None.
    """
    buffer = client._websock_connection.get_message_buffer()
    with buffer.sanctioned_dead_writes():
        yield


class Window:
    """The scene in one browser, kept up to date by calls of `update`.

    Args:
      client: The browser.
      screen: Renderer of the run.
      show_text: Shows a line of text in the page.
    """

    def __init__(self, client, screen: Screen, show_text: Callable[[str], None]):
        self._client, self._screen, self._show_text = client, screen, show_text
        self._splats = None  # handle of viser
        self._splat_unit = 1.0
        self._splat_count = 0
        self._background: tuple[int, ...] | None = None  # color, None for an image
        # Look, step, eye position, and the position that the last Gaussians depend on.
        self._splat_key: tuple | None = None
        self._send_time = 0.0  # of the last update, monotonic
        self._image = _Image()

    def update(self, state: TrainState, step: int, look: Look) -> bool:
        """Update the browser by a bounded amount of work.

        At most one tile is rendered, so that the viewer stays responsive.

        Args:
          state: Trained state.
          step: Its step.
          look: Requested time, channel and variant.

        Returns:
          True if more is left to do.
        """
        eye = eye_of(self._client.camera)
        if eye is None:
            return False
        if look.channel == "color" and self._screen.in_browser:
            return self._update_splats(state, step, eye, look)
        self._show_splats(False)
        return self._update_image(state, step, eye, look)

    def _update_splats(self, state, step, eye, look):
        self._image = _Image()
        now, key = time.monotonic(), self._splat_key
        if key is not None and key[:3] == (look, step, eye.position):
            self._show_splats(True)
            return False
        wait = self._splats_wait(look, step)
        if now - self._send_time < wait:
            time.sleep(IDLE_SECONDS)
            return wait < REFRESH_SECONDS
        if not self._screen.is_compiled(look):
            self._show_text(COMPILING)
        cloud = self._screen.splats(state, eye, look)
        self._send_splats(cloud)
        position = eye.position if cloud.view_dependent else None
        self._splat_key = look, step, eye.position, position
        self._send_time = time.monotonic()
        self._splat_count = len(cloud.centers)
        self._show_splats(True)
        self._show_text(f"{len(cloud.centers):,} Gaussians, step {step:,}")
        return True

    def _splats_wait(self, look, step):
        """Return the seconds from the last update of the Gaussians to the next."""
        if self._splat_key is None:
            return 0.0
        last_look, last_step, _, position = self._splat_key
        wait = max(
            SPLATS_SECONDS, BYTES_PER_SPLAT * self._splat_count / BYTES_PER_SECOND
        )
        if last_look != look:
            return wait
        if last_step != step:
            return max(wait, REFRESH_SECONDS)
        # Only the camera moved. No update is needed unless colors depend on the view.
        return float("inf") if position is None else max(wait, CAMERA_SECONDS)

    def _send_splats(self, cloud: SplatCloud):
        color = to_uint8(cloud.background)
        if self._background != tuple(color.tolist()):
            self._background = tuple(color.tolist())
            self._send_image(np.broadcast_to(color, (8, 8, 3)), format="png")
        arrays = self._half_range(cloud)
        with departing(self._client):
            if self._splats is None:
                self._splats = self._client.scene.add_gaussian_splats(
                    _NAME, *arrays, scale=self._splat_unit
                )
            else:
                # One message with one buffer. The browser reuses its textures if the
                # number of Gaussians has not changed.
                self._splats.set_gaussians(*arrays)

    def _half_range(self, cloud: SplatCloud):
        """Convert to arrays for viser, scaled so that covariances fit into float16."""
        covariances = np.asarray(cloud.covariances, np.float32)
        if self._splats is None:
            variance = np.trace(covariances, axis1=1, axis2=2) / 3
            typical = np.median(variance) if len(variance) else 1.0
            self._splat_unit = float(np.sqrt(max(typical, 1e-12)))
        unit = self._splat_unit
        return (
            np.asarray(cloud.centers, np.float32) / unit,
            np.clip(covariances / unit**2, -LARGEST_HALF, LARGEST_HALF),
            to_uint8(cloud.rgb),
            to_uint8(cloud.opacity)[:, None],
        )

    def _show_splats(self, visible):
        if self._splats is not None and self._splats.visible != visible:
            with departing(self._client):
                self._splats.visible = visible
        if not visible:
            self._splat_key = None

    def _update_image(self, state, step, eye, look):
        image, pyramid, now = self._image, self._screen.pyramid, time.monotonic()
        # The first level of a view is completed even if the view has changed since.
        # Otherwise nothing would be shown while the camera moves.
        is_replaceable = image.complete is not None or not image.cells
        if image.view != (eye, look) and is_replaceable:
            self._image = image = _Image(view=(eye, look), start_time=now)
        eye, look = image.view
        moving = now - image.start_time < STATIC_SECONDS
        if not image.cells:
            seconds = self._screen.tile_seconds(look)
            if image.complete is None and look.channel in ("depth", "motion"):
                seconds = None  # the coarsest image determines the range
            level = interactive.next_level(
                seconds, pyramid.levels, image.complete, moving
            )
            if (
                level is None
                and step != image.step
                and now - self._send_time > REFRESH_SECONDS
            ):
                level = image.complete
            if level is None:
                time.sleep(IDLE_SECONDS if moving else 0)
                return moving
            image.begin(pyramid, level, step)
        if not self._screen.is_compiled(look):
            self._show_text(COMPILING)
        cell = image.cells.pop(0)
        tile = self._screen.draw(state, eye, look, image.level, cell)
        image.paste(tile, cell, pyramid.tile)
        is_complete, now = not image.cells, time.monotonic()
        if is_complete:
            image.complete = image.level
        # The first level is not sent before it is complete, because the rest of its
        # canvas is black.
        due = now - self._send_time > PARTIAL_SECONDS
        if is_complete or (image.complete is not None and due):
            self._background, self._send_time = None, now
            self._send_image(image.canvas, format="jpeg")
        self._describe(image, look, step)
        return True

    def _describe(self, image, look, step):
        pyramid = self._screen.pyramid
        width, height = pyramid.size(image.level)
        text = f"{width}x{height}, step {step:,}"
        if image.cells:
            total = 4**image.level
            text += f", {total - len(image.cells)} of {total} tiles"
        elif image.level + 1 < pyramid.levels:
            text += ", refining"
        legend = self._screen.legend(look.channel)
        self._show_text(f"{text}\n\n{legend}" if legend else text)

    def _send_image(self, image, format):
        with departing(self._client):
            self._client.scene.set_background_image(
                image, format=format, jpeg_quality=JPEG_QUALITY
            )


class _Image:
    """A partially rendered image of one view."""

    def __init__(self, view: tuple[Eye, Look] | None = None, start_time: float = 0.0):
        self.view, self.start_time = view, start_time
        self.level = 0
        self.complete: int | None = None  # the finest complete level
        self.cells: list[tuple[int, int]] = []  # tiles of `level` yet to be rendered
        self.step = -1  # of training, when `level` was begun
        self.canvas: np.ndarray | None = None

    def begin(self, pyramid, level, step):
        """Begin a level with the enlarged image of the coarser one."""
        width, height = pyramid.size(level)
        if self.canvas is None:
            self.canvas = np.zeros((height, width, 3), np.uint8)
        factor = height // self.canvas.shape[0]
        self.canvas = self.canvas.repeat(factor, axis=0).repeat(factor, axis=1)
        self.level, self.step, self.cells = level, step, pyramid.tiles(level)

    def paste(self, tile, cell, size):
        """Copy a tile into the canvas."""
        (column, row), (width, height) = cell, size
        top, left = row * height, column * width
        self.canvas[top : top + height, left : left + width] = tile
