"""Interactive viewer of a run in the browser, served by viser.

Callbacks of viser only record events, with the camera and the controls at that time.
All other work happens in `Viewer.serve`, in the thread of its caller, so that nothing
is computed concurrently with a training step.
"""

import contextlib
import io
import pathlib
import queue
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerfies_jax import evaluation
from nerfies_jax.capture import camera_paths, extras
from nerfies_jax.evaluation.interactive import Look
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.runs import viewer_access
from nerfies_jax.runs.run import Run
from nerfies_jax.runs.screen import Screen
from nerfies_jax.runs.viewer_path import PathPanel, vertical_fov
from nerfies_jax.runs.viewer_training import TrainingPanel
from nerfies_jax.runs.viewer_window import COMPILING, Window, eye_of
from nerfies_jax.runtime import console, stopping
from nerfies_jax.training.loop import Hook
from nerfies_jax.training.model import TrainState

HOST = viewer_access.HOST
LIVE_SECONDS = 0.5  # maximum time between two chunks of steps for serving the viewer
PLOT_SECONDS = 1.0  # between two updates of the loss curve
IDLE_SECONDS = 0.02
MAX_FRUSTA = 48  # training cameras shown
FRUSTUM_SHARE = 0.02  # size relative to the distance from the first camera to the focus
FRUSTUM_PX = 2.0


def check_installed() -> None:
    """Check that viser is installed.

    Raises:
      MissingExtra: If it is not, with the name of the extra.
    """
    extras.check("viser", "view")


class Viewer:
    """The web page of one run.

    Args:
      run: The run.
      full: Width and height in pixels of the completely refined image of a view.
      port: Port on `HOST`. If it is in use, the next free one.
      folder: The run's folder. Camera paths are saved and rendered into it.
      in_training: True if the run is being trained, so that it can be paused.
    """

    def __init__(
        self,
        run: Run,
        full: tuple[int, int],
        port: int,
        folder: pathlib.Path,
        in_training: bool = False,
    ):
        check_installed()
        import viser

        self.screen = Screen(run, full)
        self._tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._windows: dict[int, Window] = {}
        self._clock = time.monotonic()
        self._plot_time = 0.0
        with viewer_access.guarded(), _quiet():
            self._server = viser.ViserServer(
                HOST, port, label=run.capture.name, verbose=False
            )
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._about = self._server.gui.add_markdown(COMPILING)
        distance = self._place_cameras(run)
        self._make_controls(run)
        self.path = PathPanel(
            self._server,
            self.screen,
            folder,
            self._seconds,
            FRUSTUM_SHARE * distance,
            self._defer,
            self._show_time,
        )
        self.training = TrainingPanel(self._server, self._defer, in_training)

    @property
    def address(self) -> str:
        """Address to open in a browser."""
        return f"http://{HOST}:{self._server.get_port()}"

    @property
    def holds_training(self) -> bool:
        """True if training must wait: it is paused, or a path is being rendered."""
        is_paused = self.training.is_paused(len(self._server.get_clients()))
        return is_paused or self.path.rendering is not None

    def close(self) -> None:
        """Disconnect every browser and stop listening."""
        self.path.close()
        with _quiet():
            self._server.stop()

    def serve(self, state: TrainState, step: int, seconds: float) -> None:
        """Update every browser repeatedly, at least once.

        Args:
          state: Training state to show.
          step: Its step.
          seconds: Time limit. The method returns earlier if nothing is left to do.
        """
        until = time.monotonic() + seconds
        while self._update(state, step) and time.monotonic() < until:
            pass

    def _update(self, state, step) -> bool:
        """Update each browser by a bounded amount of work. True if more is left."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._tasks.get_nowait()()
        self._advance_time()
        clients = self._server.get_clients()
        if clients and time.monotonic() - self._plot_time > PLOT_SECONDS:
            self._plot_time = time.monotonic()
            self.training.show()
        busy = self.path.advance(state, clients)
        for key in self._windows.keys() - clients.keys():
            del self._windows[key]
        look = self._look()
        for key, client in clients.items():
            if key not in self._windows:
                self._windows[key] = Window(client, self.screen, self._show_text)
            busy |= self._windows[key].update(state, step, look)
        return busy

    def _show_text(self, text):
        if self._about.content != text:
            self._about.content = text

    def _look(self) -> Look:
        appearance = self._appearance
        return Look(
            time=float(self._time.value),
            channel=self._channel.value,
            without=tuple(n for n, box in self._effects.items() if not box.value),
            appearance=self._appearances[
                0 if appearance is None else int(appearance.value)
            ],
        )

    def _advance_time(self):
        now, before = time.monotonic(), self._clock
        self._clock = now
        if self._play.value:
            step = (now - before) * self._speed.value / self._seconds
            self._show_time((self._time.value + step) % 1)

    def _show_time(self, time):
        self._time.value = round(float(time), 3)

    def _defer(self, action: Callable, argument: Callable | None = None):
        """Return a callback of viser that lets the next `_update` call `action`.

        Arguments of the action are the client, its camera as an `Eye` or None, the
        `Look`, and the result of `argument`, all as of the click. The callback is a
        coroutine, which viser awaits before it reads the next message of the browser,
        so that camera movements after the click have no effect.
        """

        async def record(event):
            eye = None if event.client is None else eye_of(event.client.camera)
            inputs: list[Any] = [event.client, eye, self._look()]
            if argument is not None:
                inputs.append(argument())
            self._tasks.put(lambda: action(*inputs))

        return record

    def _place_cameras(self, run) -> float:
        """Set the up axis and the initial camera, and add frusta of the others.

        Returns the distance of the first training camera from the focus point of all
        training cameras, in scene units.
        """
        server, capture = self._server, run.capture
        train = cameras.take(capture.cameras, capture.train)
        focus = camera_paths.focus_point(train, capture.near, capture.far)
        first = cameras.take(train, 0)
        distance = float(np.linalg.norm(focus - first.position))
        server.scene.set_up_direction(tuple(camera_paths.up_axis(capture)))
        start = server.initial_camera
        position, rows = map(np.asarray, (first.position, first.camera_from_world))
        start.position = position
        # On the viewing axis, so that the page opens with the first training view.
        start.look_at = position + distance * rows[2]
        start.up = -rows[1]
        start.fov = vertical_fov(first, capture.size)
        # Hidden at first: the initial camera is between them, and their lines would
        # cover the scene.
        self._frusta = server.scene.add_frame(
            "/cameras", show_axes=False, visible=False
        )
        # Without the initial camera, whose frustum would fill the window.
        for row in evaluation.spread(capture.train[1:], MAX_FRUSTA):
            camera = cameras.take(capture.cameras, row)
            rotation = Rotation.from_matrix(camera.camera_from_world.T)
            server.scene.add_camera_frustum(
                f"/cameras/{row}",
                vertical_fov(camera, capture.size),
                capture.size[0] / capture.size[1] / float(camera.pixel_aspect),
                scale=FRUSTUM_SHARE * distance,
                thickness=FRUSTUM_PX,
                thickness_units="screen",
                color=(255, 150, 40),
                wxyz=rotation.as_quat(scalar_first=True),
                position=np.asarray(camera.position),
            )
        return distance

    def _make_controls(self, run):
        gui, capture = self._server.gui, run.capture
        self._seconds = camera_paths.playing_seconds(capture)
        ids = np.unique(capture.appearance_ids[capture.train]).tolist()
        first = int(capture.appearance_ids[capture.train[0]])
        selectable = self.screen.parts.appearance and len(ids) > 1
        self._appearances = ids if selectable else [first]
        start = float(np.round(capture.times[capture.train[0]], 3))
        self._time = gui.add_slider("time", 0.0, 1.0, 0.001, start)
        self._play = gui.add_checkbox("play", False)
        self._speed = gui.add_slider("speed", 0.1, 4.0, 0.1, 1.0)
        self._channel = gui.add_dropdown("show", self.screen.channels)
        self._appearance = None
        if selectable:
            self._appearance = gui.add_slider(
                "appearance", 0, len(ids) - 1, 1, ids.index(first)
            )
        frusta = gui.add_checkbox("cameras", False)
        frusta.on_update(lambda _: setattr(self._frusta, "visible", frusta.value))
        with gui.add_folder("effects", visible=bool(self.screen.parts.removable)):
            self._effects = {
                name: gui.add_checkbox(name, True)
                for name in self.screen.parts.removable
            }


def _quiet():
    """Suppress the output of viser when it starts and stops.

    Commands print the address of the page themselves, and with --json nothing but the
    document may be printed.
    """
    return contextlib.redirect_stdout(io.StringIO())


@contextlib.contextmanager
def live(run: Run, folder: pathlib.Path, port: int) -> Iterator[Hook]:
    """Serve the page during training.

    Between two chunks of steps, the viewer is served for at most `LIVE_SECONDS`, or as
    long as training is paused or a camera path is rendered. Training continues when all
    browsers have disconnected. Signals end it as usual.

    Args:
      run: The run.
      folder: The run folder.
      port: Port to listen on.

    Yields:
      The training hook that serves the page.
    """
    viewer = Viewer(run, run.capture.size, port, folder, in_training=True)
    console.say(f"live view during training: {viewer.address}")

    def show(state: TrainState, step: int, metrics: Mapping[str, float]) -> None:
        viewer.training.add(step, metrics)
        viewer.serve(state, step, LIVE_SECONDS)
        while viewer.holds_training and not stopping.requested():
            viewer.serve(state, step, LIVE_SECONDS)
            time.sleep(IDLE_SECONDS)

    try:
        yield Hook("view", show, every_seconds=0.0)
    finally:
        viewer.close()
