"""Interactive viewer of a run in the browser, served by viser.

Callbacks of viser only record clicks, with the camera and the controls at that time.
Everything else happens in `Viewer.serve`, in the thread of its caller, so that nothing
is computed concurrently with a training step.
"""

import contextlib
import io
import pathlib
import queue
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
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
LIVE_SECONDS = 0.5  # training waits so long at a time for who looks around
PLOT_SECONDS = 1.0  # between two updates of the curve
IDLE_SECONDS = 0.02
FRUSTA = 48  # training cameras shown
FRUSTUM_SHARE = 0.02  # of the way from the cameras to what they look at
FRUSTUM_PX = 2.0


def check_installed() -> None:
    """Check that viser is installed.

    Raises:
      MissingExtra: If it is not, with the name of the extra.
    """
    extras.check("viser", "view")


class Viewer:
    """The page of one run.

    Args:
      run: The run.
      full: Width and height in pixels of images of a static view.
      port: Port on `HOST`, or the next free one.
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
        self._orders: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._windows: dict[int, Window] = {}
        self._clock = time.monotonic()
        self._plotted = 0.0
        with viewer_access.guarded(), _quiet():
            self._server = viser.ViserServer(
                HOST, port, label=run.capture.name, verbose=False
            )
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._about = self._server.gui.add_markdown(COMPILING)
        away = self._place_cameras(run)
        self._make_controls(run)
        self.path = PathPanel(
            self._server,
            self.screen,
            folder,
            self._seconds,
            FRUSTUM_SHARE * away,
            self._ordered,
            self._show_time,
        )
        self.training = TrainingPanel(self._server, self._ordered, in_training)

    @property
    def address(self) -> str:
        """Address to open in a browser."""
        return f"http://{HOST}:{self._server.get_port()}"

    @property
    def holds_training(self) -> bool:
        """True if training must wait: it is paused, or a path is being rendered."""
        held = self.training.held(len(self._server.get_clients()))
        return held or self.path.rendering is not None

    def close(self) -> None:
        """Disconnect every browser and stop listening."""
        self.path.close()
        with _quiet():
            self._server.stop()

    def serve(self, state: TrainState, step: int, seconds: float) -> None:
        """Update every browser for some time, at least once.

        Returns early if nothing is left to do.

        Args:
          state: Training state to show.
          step: Its step.
          seconds: Time limit.
        """
        until = time.monotonic() + seconds
        while self._round(state, step) and time.monotonic() < until:
            pass

    def add_metrics(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add the metrics of a step to the curve.

        Args:
          step: The step.
          metrics: Metrics by name.
        """
        self.training.add(step, metrics)

    def add_history(self, rows: Sequence[Mapping[str, float]]) -> None:
        """Add the metrics of an earlier training to the curve.

        Args:
          rows: Metrics by name, with "step".
        """
        for row in rows:
            self.training.add(int(row["step"]), row)

    def _round(self, state, step) -> bool:
        """Update each browser by a bounded amount of work. True if more is left."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._orders.get_nowait()()
        self._advance_time()
        clients = self._server.get_clients()
        if clients and time.monotonic() - self._plotted > PLOT_SECONDS:
            self._plotted = time.monotonic()
            self.training.show()
        busy = self.path.advance(state, clients)
        for key in self._windows.keys() - clients.keys():
            del self._windows[key]
        look = self._look()
        for key, client in clients.items():
            if key not in self._windows:
                self._windows[key] = Window(client, self.screen, self._tell)
            busy |= self._windows[key].update(state, step, look)
        return busy

    def _tell(self, text):
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
            passed = (now - before) * self._speed.value / self._seconds
            self._show_time((self._time.value + passed) % 1)

    def _show_time(self, time):
        self._time.value = round(float(time), 3)

    def _ordered(self, action: Callable, argument: Callable | None = None):
        """Return a callback of viser that has `action` run in the next round.

        The action gets the client, its camera as an `Eye` or None, the `Look`, and what
        `argument` returns, all as of the click: viser awaits a coroutine before it
        reads the browser's next message, so a camera that moves right after the click
        is not taken for that of the click.
        """

        async def note(event):
            eye = None if event.client is None else eye_of(event.client.camera)
            inputs: list[Any] = [event.client, eye, self._look()]
            if argument is not None:
                inputs.append(argument())
            self._orders.put(lambda: action(*inputs))

        return note

    def _place_cameras(self, run) -> float:
        """Up axis, the first training camera as the start, and frusta of the others.

        Returns how far that camera is from what the cameras look at, scene units.
        """
        server, capture = self._server, run.capture
        train = cameras.take(capture.cameras, capture.train)
        focus = camera_paths.focus_point(train, capture.near, capture.far)
        first = cameras.take(train, 0)
        away = float(np.linalg.norm(focus - first.position))
        server.scene.set_up_direction(tuple(camera_paths.up_axis(capture)))
        start = server.initial_camera
        position, rows = map(np.asarray, (first.position, first.camera_from_world))
        start.position = position
        # On the viewing axis, so that the page opens with the first training view.
        start.look_at = position + away * rows[2]
        start.up = -rows[1]
        start.fov = vertical_fov(first, capture.size)
        # At the start one stands among them: their lines would hide the scene.
        self._frusta = server.scene.add_frame(
            "/cameras", show_axes=False, visible=False
        )
        # Not that of the start itself, whose frame would fill the window.
        for row in evaluation.spread(capture.train[1:], FRUSTA):
            one = cameras.take(capture.cameras, row)
            turn = Rotation.from_matrix(one.camera_from_world.T)
            server.scene.add_camera_frustum(
                f"/cameras/{row}",
                vertical_fov(one, capture.size),
                capture.size[0] / capture.size[1] / float(one.pixel_aspect),
                scale=FRUSTUM_SHARE * away,
                thickness=FRUSTUM_PX,
                thickness_units="screen",
                color=(255, 150, 40),
                wxyz=turn.as_quat(scalar_first=True),
                position=np.asarray(one.position),
            )
        return away

    def _make_controls(self, run):
        gui, capture = self._server.gui, run.capture
        self._seconds = camera_paths.playing_seconds(capture)
        known = np.unique(capture.appearance_ids[capture.train]).tolist()
        first = int(capture.appearance_ids[capture.train[0]])
        varied = self.screen.parts.appearance and len(known) > 1
        self._appearances = known if varied else [first]
        start = float(np.round(capture.times[capture.train[0]], 3))
        self._time = gui.add_slider("time", 0.0, 1.0, 0.001, start)
        self._play = gui.add_checkbox("play", False)
        self._speed = gui.add_slider("speed", 0.1, 4.0, 0.1, 1.0)
        self._channel = gui.add_dropdown("show", self.screen.channels)
        self._appearance = None
        if varied:
            self._appearance = gui.add_slider(
                "appearance", 0, len(known) - 1, 1, known.index(first)
            )
        frusta = gui.add_checkbox("cameras", False)
        frusta.on_update(lambda _: setattr(self._frusta, "visible", frusta.value))
        with gui.add_folder("effects", visible=bool(self.screen.parts.removable)):
            self._effects = {
                name: gui.add_checkbox(name, True)
                for name in self.screen.parts.removable
            }


def _quiet():
    """Drop what viser prints when it starts and stops.

    Commands say where the page is, and may print one JSON document and nothing else.
    """
    return contextlib.redirect_stdout(io.StringIO())


@contextlib.contextmanager
def live(run: Run, folder: pathlib.Path, port: int) -> Iterator[Hook]:
    """Serve the page while the run is trained.

    Training waits at most `LIVE_SECONDS` between two chunks of steps for a user who
    looks around, and as long as someone pauses it or renders a camera path. It
    continues when every browser has left, and ends at a signal as always.

    Args:
      run: The run.
      folder: The run folder.
      port: Port to listen on.

    Yields:
      The training hook that serves the page.
    """
    viewer = Viewer(run, run.capture.size, port, folder, in_training=True)
    console.say(f"look around while it trains: {viewer.address}")

    def show(state: TrainState, step: int, metrics: Mapping[str, float]) -> None:
        viewer.add_metrics(step, metrics)
        viewer.serve(state, step, LIVE_SECONDS)
        while viewer.holds_training and not stopping.requested():
            viewer.serve(state, step, LIVE_SECONDS)
            time.sleep(IDLE_SECONDS)

    try:
        yield Hook("view", show, every_seconds=0.0)
    finally:
        viewer.close()
