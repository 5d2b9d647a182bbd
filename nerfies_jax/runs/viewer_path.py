"""Editor of camera paths in the viewer: keyframes, preview, files and rendering."""

import pathlib
import shlex
import tempfile
import time
from collections.abc import Callable, Generator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerfies_jax.capture import keyframes, path_files
from nerfies_jax.capture.camera_paths import CameraPath
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.keyframes import Keyframe
from nerfies_jax.evaluation import Renderer, interactive, path_views
from nerfies_jax.evaluation.interactive import Eye, Look
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.runs import path_images
from nerfies_jax.runs.run_folder import EXPORTS, RENDERS
from nerfies_jax.runs.screen import Screen
from nerfies_jax.runs.viewer_window import departing
from nerfies_jax.runtime import console
from nerfies_jax.training.model import TrainState, View, in_default_precision

RATE = 24.0  # images per second of a path
CURVE_POINTS = 200  # of the path shown in the scene
FRUSTUM_PX = 2.0
COLOR = (60, 170, 255)
GO, SET, UP, DOWN, DELETE = "go", "set", "↑", "↓", "✕"
ACTIONS = (GO, SET, UP, DOWN, DELETE)  # of a keyframe. Five buttons fit into a line.
_HINT = (
    f"{GO}: view it. {SET}: replace it by the current view and time. "
    f"{UP} {DOWN}: move it in the list. {DELETE}: delete it."
)
_EMPTY = "Move to the first view and time of the path, and add it as a keyframe."
_NAME = "/path"


class PathPanel:
    """Keyframes, and the controls of the camera path through them.

    The threads of viser execute nothing here. `deferred` turns an action `(client, eye,
    look)` into a callback that lets the thread of the viewer run the action, with the
    camera and the controls as of the click.

    Args:
      server: The server of viser.
      screen: Renderer of the run.
      run_folder: The folder of the run, for paths and their images.
      seconds: Initial duration of a path.
      frustum_scale: Size of the frusta of keyframes in scene units.
      deferred: Makes a callback of an action, as above.
      show_time: Sets the time of the scene in all browsers.
    """

    def __init__(
        self,
        server: Any,
        screen: Screen,
        run_folder: pathlib.Path,
        seconds: float,
        frustum_scale: float,
        deferred: Callable[..., Callable],
        show_time: Callable[[float], None],
    ):
        self.keyframes: list[Keyframe] = []
        self.rendering: Generator[int, TrainState, None] | None = None
        self._server, self._screen, self._folder = server, screen, run_folder
        self._scale, self._deferred = frustum_scale, deferred
        self._show_time = show_time
        # Client, path and start time of the preview.
        self._preview: tuple[Any, CameraPath, float] | None = None
        self._total = 0  # images of the path that is rendered
        self._rows: list[Any] = []  # handles of viser for the list of keyframes
        self._handles: list[Any] = []  # and for the objects in the scene
        gui = server.gui
        with gui.add_folder("camera path") as self._panel:
            self._message = gui.add_markdown(_EMPTY)
            with gui.add_folder("keyframes", visible=False) as self._list:
                pass
            self._button("add keyframe", self._add, color=None)
            self._length = gui.add_number("seconds", seconds, min=0.1, step=0.1)
            self._visible = gui.add_checkbox("show path", True)
            self._visible.on_update(deferred(lambda *_: self._draw()))
            self._play = self._button("preview", self._toggle_preview)
            self._button("save", self._save)
            loading = gui.add_upload_button(
                "load", mime_type="application/json,.json", color="gray"
            )
            # The content is read at once, because the next upload replaces it.
            loading.on_upload(deferred(self._load, lambda: loading.value.content))
            self._render = self._button("render", self._toggle_render)
            self._progress = gui.add_progress_bar(0.0, visible=False)

    def _button(self, label, action, color="gray"):
        button = self._server.gui.add_button(label, color=color)
        button.on_click(self._deferred(action))
        return button

    def close(self) -> None:
        """Stop rendering and remove its incomplete result."""
        if self.rendering is not None:
            self.rendering.close()
            self.rendering = None

    def advance(self, state: TrainState, clients) -> bool:
        """Move the preview and render one image.

        Args:
          state: Trained state.
          clients: Connected browsers.

        Returns:
          True if either continues.
        """
        if self._preview is not None:
            self._advance_preview(clients)
        if self.rendering is not None:
            self._advance_rendering(state)
        return self._preview is not None or self.rendering is not None

    # Keyframes

    def _add(self, client, eye, look):
        del client
        if eye is not None:
            self.keyframes.append(self._keyframe(eye, look))
            self._update()

    def _keyframe(self, eye: Eye, look: Look) -> Keyframe:
        size = self._screen.run.capture.size
        square = eye._replace(aspect=size[0] / size[1])
        return Keyframe(interactive.camera_of(square, size), look.time)

    def _edit(self, index, action, client, eye, look):
        """Perform the action of a button of a keyframe."""
        frames = self.keyframes
        if index >= len(frames):
            return
        if action == GO:
            self._stop_preview()
            self._go(client, frames[index])
            return
        if action == SET:
            if eye is not None:
                frames[index] = self._keyframe(eye, look)
        elif action == DELETE:
            del frames[index]
        else:
            other = index + (1 if action == DOWN else -1)
            if 0 <= other < len(frames):
                frames[index], frames[other] = frames[other], frames[index]
        self._update()

    def _update(self):
        """Update the list of keyframes and the path in the scene."""
        self._stop_preview()
        for row in self._rows:
            row.remove()
        self._rows = []
        with self._list:
            for index, keyframe in enumerate(self.keyframes):
                label = f"{index + 1}: t {keyframe.time:.3f}"
                row = self._server.gui.add_button_group(label, ACTIONS, hint=_HINT)
                row.on_click(self._edit_callback(index, row))
                self._rows.append(row)
        self._list.visible = bool(self.keyframes)
        self._message.content = "" if self.keyframes else _EMPTY
        self._draw()

    def _edit_callback(self, index, row):
        def edit(client, eye, look, action):
            self._edit(index, action, client, eye, look)

        return self._deferred(edit, lambda: row.value)

    # In the scene

    def _draw(self):
        for handle in self._handles:
            handle.remove()
        self._handles = []
        if not self._visible.value:
            return
        scene, size = self._server.scene, self._screen.run.capture.size
        for index, keyframe in enumerate(self.keyframes):
            camera = keyframe.camera
            rotation = Rotation.from_matrix(camera.camera_from_world.T)
            self._handles.append(
                scene.add_camera_frustum(
                    f"{_NAME}/keyframe {index + 1}",
                    vertical_fov(camera, size),
                    size[0] / size[1] / float(camera.pixel_aspect),
                    scale=self._scale,
                    thickness=FRUSTUM_PX,
                    thickness_units="screen",
                    color=COLOR,
                    wxyz=rotation.as_quat(scalar_first=True),
                    position=camera.position,
                )
            )
        if len(self.keyframes) >= 2:
            count = max(CURVE_POINTS, len(self.keyframes))
            points = keyframes.through(self.keyframes, size, count).cameras.position
            self._handles.append(
                scene.add_line_segments(
                    f"{_NAME}/curve",
                    np.stack([points[:-1], points[1:]], axis=1),
                    COLOR,
                    thickness=FRUSTUM_PX,
                    thickness_units="screen",
                )
            )

    # Preview

    def _toggle_preview(self, client, eye, look):
        del eye, look
        if self._preview is not None:
            self._stop_preview()
            return
        path = self._path()
        if path is not None and client is not None:
            self._preview = client, path, time.monotonic()
            self._play.label = "stop the preview"

    def _advance_preview(self, clients):
        client, path, start_time = self._preview
        last = len(path.times) - 1
        row = round((time.monotonic() - start_time) * RATE)
        if client.client_id not in clients or row > last:
            self._stop_preview()
            row = last
        camera = cameras.take(path.cameras, row)
        self._go(client, Keyframe(camera, float(path.times[row])))

    def _stop_preview(self):
        if self._preview is not None:
            self._preview = None
            self._play.label = "preview"

    def _go(self, client, keyframe: Keyframe):
        """Move the camera of a browser to a keyframe, and show its time."""
        if client is None:
            return
        rotation = Rotation.from_matrix(keyframe.camera.camera_from_world.T)
        with departing(client), client.atomic():
            client.camera.position = keyframe.camera.position
            client.camera.wxyz = rotation.as_quat(scalar_first=True)
            client.camera.fov = vertical_fov(
                keyframe.camera, self._screen.run.capture.size
            )
        self._show_time(keyframe.time)

    # Files

    def _path(self) -> CameraPath | None:
        """Return the path, or None after showing the reason in the page."""
        count = max(round(RATE * self._length.value), len(self.keyframes))
        try:
            size = self._screen.run.capture.size
            return keyframes.through(self.keyframes, size, count)
        except ValueError as error:
            self._message.content = str(error)
            return None

    def _save(self, *_):
        path = self._path()
        if path is None:
            return
        file = _next_name(self._folder / EXPORTS, "path-", ".json")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            path_files.write_nerfstudio(file, path, RATE, keyframes=self.keyframes)
        except (ValueError, OSError) as error:
            self._message.content = f"Could not be saved: {error}"
            return
        words = ("nerfies", "render", str(self._folder), "--path", str(file))
        render = shlex.join(words)
        self._message.content = f"Saved. To render it later:\n\n`{render}`"
        console.say(f"{len(path.times)} cameras: {file}; {render}")

    def _load(self, client, eye, look, content: bytes):
        del client, eye, look
        with tempfile.TemporaryDirectory() as folder:
            file = pathlib.Path(folder) / "camera path"
            file.write_bytes(content)
            try:
                new_keyframes = path_files.read_keyframes(
                    file, self._screen.run.capture
                )
            except CaptureError as error:
                reason = str(error).replace(f"{file}: ", "")
                self._message.content = f"Could not be loaded: {reason}"
                return
        self.keyframes = new_keyframes
        self._update()
        self._message.content = f"{len(new_keyframes)} keyframes loaded."

    # Rendering

    def _toggle_render(self, client, eye, look):
        del client, eye
        if self.rendering is not None:
            self._end_rendering("Rendering was canceled. No images were kept.")
            return
        path = self._path()
        if path is None:
            return
        out = _next_name(self._folder / RENDERS, "path-", "")
        screen, total = self._screen, len(path.times)

        def images():
            # One state for all images: training waits until the last one.
            state = yield 0
            out.parent.mkdir(parents=True, exist_ok=True)
            first = View(
                cameras.take(path.cameras, 0),
                np.float32(look.time),
                np.int32(look.appearance),
            )
            views = path_views(path.cameras, path.times, in_default_precision(first))
            renderer = Renderer(screen.model(look.without), path.size)
            yield from path_images.render(out, renderer, state, views, RATE)

        self.rendering, self._out, self._total = images(), out, total
        next(self.rendering)
        self._progress.value, self._progress.visible = 0.0, True
        self._render.label = "cancel rendering"
        width, height = path.size
        self._message.content = f"Rendering {total} images of {width}x{height}."

    def _advance_rendering(self, state):
        try:
            count = self.rendering.send(state)
        except StopIteration:
            self._end_rendering(f"{self._total} images: `{self._out}`")
            console.say(f"{self._total} images: {self._out}")
        except (CaptureError, OSError, ValueError) as error:
            self._end_rendering(f"Could not be rendered: {error}")
        else:
            self._progress.value = 100.0 * count / self._total
            self._message.content = f"{count} of {self._total} images rendered."

    def _end_rendering(self, message):
        self.close()
        self._progress.visible = False
        self._render.label = "render"
        self._message.content = message


def vertical_fov(camera: Camera, size: tuple[int, int]) -> float:
    """Return the vertical field of view of a camera.

    Args:
      camera: The camera.
      size: Width and height of its images in pixels.

    Returns:
      The angle in radians.
    """
    vertical_px = float(camera.focal_px) * float(camera.pixel_aspect)
    return 2 * float(np.arctan2(size[1], 2 * vertical_px))


def _next_name(folder: pathlib.Path, stem: str, suffix: str) -> pathlib.Path:
    """Return the first of STEM1, STEM2, ... that does not exist."""
    number = 1
    while (path := folder / f"{stem}{number}{suffix}").exists():
        number += 1
    return path
