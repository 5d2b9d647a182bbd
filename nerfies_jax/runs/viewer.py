"""A page in the browser to look around in a run, drawn here and sent by viser.

viser's own threads only note what was pressed: all drawing happens in `Viewer.serve`,
in the thread of whoever calls it, so that it never runs beside a training step.
"""

import contextlib
import dataclasses
import logging
import pathlib
import queue
import shlex
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerfies_jax import console, evaluation
from nerfies_jax.capture import camera_paths, extras, keyframes, path_files
from nerfies_jax.capture.keyframes import Keyframe
from nerfies_jax.evaluation import interactive
from nerfies_jax.evaluation.interactive import Eye, Look
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.runs.run import Run
from nerfies_jax.runs.run_folder import EXPORTS
from nerfies_jax.runs.screen import Screen
from nerfies_jax.training.loop import Hook
from nerfies_jax.training.model import TrainState

HOST = "127.0.0.1"  # this machine alone
STILL_SECONDS = 0.3  # without a change until a view counts as resting
REFRESH_SECONDS = 2.0  # between two pictures of a resting view while training goes on
LIVE_SECONDS = 0.5  # training waits so long at a time for who looks around
IDLE_SECONDS = 0.02
FRUSTA = 48  # training cameras shown
FRUSTUM_SHARE = 0.02  # of the way from the cameras to what they look at
FRUSTUM_PX = 2.0
RATE = 24.0  # pictures per second of a path
JPEG_QUALITY = 90


def check_installed() -> None:
    """Raise MissingExtra, which names the extra, where viser is not installed."""
    extras.check("viser", "view")


@dataclasses.dataclass
class _Shown:
    """What the last picture that a browser got shows."""

    seen: tuple[Eye, Look] | None = None
    rung: int | None = None
    step: int = -1
    changed: float = 0.0  # when the view last did, by the monotonic clock
    drawn: float = 0.0


class Viewer:
    """The page of one run, on `HOST`; `paths` is the folder for paths saved there.

    `full` is the size of the pictures of a resting view; the next free `port` is taken.
    """

    def __init__(self, run: Run, full: tuple[int, int], port: int, paths: pathlib.Path):
        check_installed()
        import viser

        self.screen, self.paths = Screen(run, full), paths
        self.keyframes: list[Keyframe] = []
        self._orders: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._shown: dict[int, _Shown] = {}
        self._clock = time.monotonic()
        # A browser that opens a connection and leaves is no error to tell.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        self._server = viser.ViserServer(
            HOST, port, label=run.capture.name, verbose=False
        )
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._place_cameras(run)
        self._controls = self._make_controls(run)

    @property
    def address(self) -> str:
        """To be opened in a browser."""
        return f"http://{HOST}:{self._server.get_port()}"

    def close(self) -> None:
        """Disconnect every browser and stop listening."""
        self._server.stop()

    def serve(self, state: TrainState, step: int, seconds: float) -> None:
        """Answer whoever looks, for so long; while training goes on, once at least.

        Returns early where nothing is left to draw and nothing plays.
        """
        until = time.monotonic() + seconds
        while self._round(state, step) and time.monotonic() < until:
            pass

    def _round(self, state, step) -> bool:
        """One picture for each browser that wants one; whether there was any."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._orders.get_nowait()()
        self._play()
        drew = False
        clients = self._server.get_clients()
        self._shown = {key: self._shown.get(key, _Shown()) for key in clients}
        for key, client in clients.items():
            drew |= self._answer(client, self._shown[key], state, step)
        return drew

    def _answer(self, client, shown, state, step) -> bool:
        eye, now = _eye(client.camera), time.monotonic()
        if eye is None:
            return False
        look = self._look()
        if (eye, look) != shown.seen:
            shown.seen, shown.rung, shown.changed = (eye, look), None, now
        moving = now - shown.changed < STILL_SECONDS
        seconds = self.screen.seconds(look)
        rung = interactive.next_rung(seconds, moving, shown.rung)
        stale = step != shown.step and now - shown.drawn > REFRESH_SECONDS
        if rung is None and stale:
            rung = shown.rung
        if rung is None:
            time.sleep(IDLE_SECONDS if moving else 0)
            return moving
        picture = self.screen.draw(state, eye, look, rung)
        client.scene.set_background_image(
            picture, format="jpeg", jpeg_quality=JPEG_QUALITY
        )
        shown.rung, shown.step, shown.drawn = rung, step, time.monotonic()
        self._tell(look, rung, step)
        return True

    def _look(self) -> Look:
        controls = self._controls
        left_out = [n for n, box in controls["effects"].items() if not box.value]
        chosen = controls["appearance"]
        return Look(
            time=float(controls["time"].value),
            channel=controls["channel"].value,
            without=tuple(left_out),
            appearance=self._appearances[0 if chosen is None else int(chosen.value)],
        )

    def _play(self) -> None:
        now, before = time.monotonic(), self._clock
        self._clock = now
        controls = self._controls
        if controls["play"].value:
            passed = (now - before) * controls["speed"].value / self._seconds
            controls["time"].value = round((controls["time"].value + passed) % 1, 3)

    def _tell(self, look, rung, step) -> None:
        width, height = self.screen.sizes[rung]
        seconds = self.screen.seconds(look)[rung]
        text = f"{width}x{height}, {1e3 * seconds:.0f} ms, step {step:,}"
        legend = self.screen.legend(look.channel)
        finest = rung + 1 == len(self.screen.sizes)
        if not finest and 4 * seconds > interactive.RESTING_SECONDS:
            text += ". Coarse: larger pictures of this run take too long here."
        text += f"\n\n{legend}" if legend else ""
        if self._controls["about"].content != text:
            self._controls["about"].content = text

    def _place_cameras(self, run):
        """Up axis, the first training camera as the start, and frusta of the others."""
        server, capture = self._server, run.capture
        train = cameras.take(capture.cameras, capture.train)
        focus = camera_paths.focus_point(train, capture.near, capture.far)
        first = cameras.take(train, 0)
        away = float(np.linalg.norm(focus - first.position))
        server.scene.set_up_direction(tuple(camera_paths.up_axis(capture)))
        start = server.initial_camera
        start.position = first.position
        # On the viewing axis, so that the page opens with the first picture.
        start.look_at = first.position + away * first.camera_from_world[2]
        start.up = -first.camera_from_world[1]
        start.fov = _vertical_fov(first, capture.size)
        # At the start one stands among them: their lines would hide the picture.
        self._frusta = server.scene.add_frame(
            "/cameras", show_axes=False, visible=False
        )
        # Not that of the start itself, whose frame would fill the window.
        for row in evaluation.spread(capture.train[1:], FRUSTA):
            one = cameras.take(capture.cameras, row)
            turn = Rotation.from_matrix(one.camera_from_world.T)
            server.scene.add_camera_frustum(
                f"/cameras/{row}",
                _vertical_fov(one, capture.size),
                capture.size[0] / capture.size[1] / float(one.pixel_aspect),
                scale=FRUSTUM_SHARE * away,
                thickness=FRUSTUM_PX,
                thickness_units="screen",
                color=(255, 150, 40),
                wxyz=turn.as_quat(scalar_first=True),
                position=one.position,
            )

    def _make_controls(self, run) -> dict[str, Any]:
        gui, capture = self._server.gui, run.capture
        self._seconds = camera_paths.playing_seconds(capture)
        known = np.unique(capture.appearance_ids[capture.train]).tolist()
        first = int(capture.appearance_ids[capture.train[0]])
        varied = self.screen.parts.appearance and len(known) > 1
        self._appearances = known if varied else [first]
        made: dict[str, Any] = {"appearance": None}
        moment = float(np.round(capture.times[capture.train[0]], 3))
        made["time"] = gui.add_slider("time", 0.0, 1.0, 0.001, moment)
        made["play"] = gui.add_checkbox("play", False)
        made["speed"] = gui.add_slider("speed", 0.1, 4.0, 0.1, 1.0)
        made["channel"] = gui.add_dropdown("show", self.screen.channels)
        if varied:
            made["appearance"] = gui.add_slider(
                "appearance", 0, len(known) - 1, 1, known.index(first)
            )
        frusta = gui.add_checkbox("cameras", False)
        frusta.on_update(lambda _: setattr(self._frusta, "visible", frusta.value))
        with gui.add_folder("effects", visible=bool(self.screen.parts.removable)):
            made["effects"] = {
                name: gui.add_checkbox(name, True)
                for name in self.screen.parts.removable
            }
        with gui.add_folder("camera path"):
            made["listed"] = gui.add_markdown(_NO_KEYFRAMES)
            made["length"] = gui.add_number("seconds", self._seconds, min=0.1, step=0.1)
            buttons = {
                "add keyframe": self._add_keyframe,
                "remove the last": self._remove_keyframe,
                "save": self._save_path,
            }
            for label, action in buttons.items():
                gui.add_button(label).on_click(self._ordered(action))
        # Last, since it changes its length.
        made["about"] = gui.add_markdown("The first picture comes when it is compiled.")
        return made

    def _ordered(self, action):
        """A callback that leaves `action` to the next round."""
        return lambda event: self._orders.put(lambda: action(event.client))

    def _add_keyframe(self, client):
        eye = None if client is None else _eye(client.camera)
        if eye is not None:
            size = self.screen.run.capture.size
            square = eye._replace(aspect=size[0] / size[1])
            camera = interactive.camera_of(square, size)
            self.keyframes.append(Keyframe(camera, self._look().time))
            self._list_keyframes()

    def _remove_keyframe(self, client):
        del client
        del self.keyframes[-1:]
        self._list_keyframes()

    def _list_keyframes(self):
        lines = [
            f"{number}. time {keyframe.time:.3f}"
            for number, keyframe in enumerate(self.keyframes, 1)
        ]
        self._controls["listed"].content = "\n".join(lines) or _NO_KEYFRAMES

    def _save_path(self, client):
        """The path as nerfstudio's file, or why there is none, said in the page."""
        del client
        count = max(round(RATE * self._controls["length"].value), len(self.keyframes))
        size = self.screen.run.capture.size
        number = 1
        while (place := self.paths / f"path-{number}.json").exists():
            number += 1
        try:
            path = keyframes.through(self.keyframes, size, count)
            place.parent.mkdir(parents=True, exist_ok=True)
            path_files.write_nerfstudio(place, path, RATE)
        except (ValueError, OSError) as error:
            self._controls["listed"].content = str(error)
            return
        words = "experiments.render", str(self.paths.parent), "--path", str(place)
        render = shlex.join(("python", "-m", *words))
        self._controls["listed"].content = f"Saved. To render it:\n\n`{render}`"
        console.say(f"{count} cameras: {place}; {render}")


_NO_KEYFRAMES = "Look from where it shall begin, at the time it shall show; add it."


def _eye(camera) -> Eye | None:
    """None until the browser has told where it looks from."""
    if camera.update_timestamp == 0 or not camera.image_height:
        return None
    return Eye(
        quaternion=tuple(np.asarray(camera.wxyz, np.float64).tolist()),
        position=tuple(np.asarray(camera.position, np.float64).tolist()),
        fov_rad=float(camera.fov),
        aspect=float(camera.image_width / camera.image_height),
    )


def _vertical_fov(camera, size):
    vertical_px = float(camera.focal_px) * float(camera.pixel_aspect)
    return 2 * float(np.arctan2(size[1], 2 * vertical_px))


@contextlib.contextmanager
def live(run: Run, folder: pathlib.Path, port: int) -> Iterator[Hook]:
    """The page while the run is trained: what to call between its chunks of steps.

    It waits `LIVE_SECONDS` at most for whoever looks around, and draws a resting view
    again every `REFRESH_SECONDS`.
    """
    viewer = Viewer(run, run.capture.size, port, folder / EXPORTS)
    console.say(f"look around while it trains: {viewer.address}")

    def show(state: TrainState, step: int, metrics: dict[str, float]) -> None:
        del metrics
        viewer.serve(state, step, LIVE_SECONDS)

    try:
        yield Hook("view", show, every_seconds=0.0)
    finally:
        viewer.close()
