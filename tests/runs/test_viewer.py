"""A page to look around in: the browser's side of it, without a browser."""

import contextlib
import io
import re
import signal
import sys
import threading
import time
import warnings

import jax
import msgspec
import numpy as np
import PIL.Image
import pytest
from scipy.spatial.transform import Rotation

from nerfies_jax import evaluation, runs
from nerfies_jax.capture import path_files
from nerfies_jax.evaluation.interactive import Eye, Look
from nerfies_jax.runs import representations, screen, viewer, viewer_training
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.runtime import stopping
from nerfies_jax.training import loop
from tests import scenes

viser = pytest.importorskip("viser")
zstandard = pytest.importorskip("zstandard")  # which viser brings along
CAPTURE = scenes.tiny_capture()
SPECS = {"gaussians": scenes.TINY_DEFORMABLE, "radiance": scenes.TINY_FIELD}


def a_run(kind, shaken=0.1):
    """A run of the tiny capture, and its state, in which something moves."""
    config = RunConfig("splats-static-small", CaptureSource())
    run = runs.open_run(config, representations.named(kind), SPECS[kind], CAPTURE)
    state, rng = runs.initial_state(run), np.random.default_rng(0)

    def shake(leaf):
        return leaf + np.asarray(shaken * rng.normal(size=leaf.shape), leaf.dtype)

    params = state.params
    if kind == "gaussians":
        rows = params.rows["splats"]
        opaque = rows._replace(opacity_logit=rows.opacity_logit + 4)
        params = params._replace(
            rows=params.rows | {"splats": opaque},
            nets=jax.tree.map(shake, params.nets),
        )
    else:
        params = params | {"warp": jax.tree.map(shake, params["warp"])}
        params = params | {"codes": jax.tree.map(shake, params["codes"])}
    return run, state._replace(params=params)


def eye_of(row):
    """Where a frame was taken from, as viser tells it."""
    one = jax.tree.map(lambda leaf: leaf[row], CAPTURE.cameras)
    turn = Rotation.from_matrix(one.camera_from_world.T)
    return Eye(
        tuple(turn.as_quat(scalar_first=True).tolist()),
        tuple(one.position.tolist()),
        2 * float(np.arctan2(CAPTURE.size[1] / 2, one.focal_px * one.pixel_aspect)),
        CAPTURE.size[0] / CAPTURE.size[1] * float(one.pixel_aspect),
    )


def whole(shown, state, eye, look, level):
    """The image of a level, its tiles rendered one by one."""
    width, height = shown.pyramid.size(level)
    image = np.zeros((height, width, 3), np.uint8)
    wide, high = shown.pyramid.tile
    for column, row in shown.pyramid.tiles(level):
        tile = shown.draw(state, eye, look, level, (column, row))
        image[row * high :, column * wide :][:high, :wide] = tile
    return image


@pytest.mark.parametrize(
    "kind", ["gaussians", pytest.param("radiance", marks=pytest.mark.full)]
)
def test_a_screen_draws_what_the_renderer_draws_and_without_effects(kind, monkeypatch):
    # Four tiles, the last column and row a pixel beyond the image.
    for name in ("TRACED_PIXELS", "RASTERIZED_PIXELS"):
        monkeypatch.setattr(screen, name, 400)
    run, state = a_run(kind)
    shown = screen.Screen(run, (39, 29))
    assert shown.pyramid == ((20, 15), 2)
    row = int(CAPTURE.train[0])
    first = Look(float(CAPTURE.times[row]), appearance=int(CAPTURE.appearance_ids[row]))
    eye = eye_of(row)
    image = whole(shown, state, eye, first, 1)
    renderer = evaluation.Renderer(run.model, CAPTURE.size)
    expected = renderer(state, evaluation.view_of(CAPTURE, row)).color
    difference = image - 255.0 * expected.clip(0, 1)
    # 8 bits round by half; the pose went through a quaternion
    assert np.abs(difference).mean() < 0.6
    assert shown.tile_seconds(first) > 0
    later = first._replace(time=0.9)
    name = {"gaussians": "motion", "radiance": "warp"}[kind]
    assert name in shown.parts.removable
    frozen = [
        shown.draw(state, eye, look._replace(without=(name,)), 0, (0, 0))
        for look in (first, later)
    ]
    np.testing.assert_array_equal(*frozen)
    assert (whole(shown, state, eye, later, 1) != image).any()
    # How far things moved since time 0: nothing at 0, something later. Tiles are
    # colored over the range of the coarse image before them.
    dark, bright = (
        whole(shown, state, eye, Look(time, "motion"), 0) for time in (0.0, 0.9)
    )
    known = (dark != 128).any(axis=-1)
    assert known.sum() > 20
    assert dark[known].max() < 10 < bright[known].max()
    fine = whole(shown, state, eye, Look(0.9, "motion"), 1)
    assert np.abs(fine[::2, ::2].astype(float) - bright).mean() < 40
    varied = whole(shown, state, eye, first._replace(appearance=1), 1)
    assert (varied != image).any() == (kind == "radiance")


class Browser:
    """What a browser sends, and what it gets."""

    def __init__(self, address):
        from websockets.sync.client import connect

        self._socket = connect(
            address.replace("http", "ws"),
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
        )
        self.image, self.splats, self.visible = None, None, False

    def close(self):
        self._socket.close()

    def send(self, kind, **fields):
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look(self, eye):
        self.send(
            "ViewerCameraMessage",
            wxyz=eye.quaternion,
            position=eye.position,
            fov=eye.fov_rad,
            near=0.01,
            far=1000.0,
            image_height=300,
            image_width=round(300 * eye.aspect),
            look_at=(0.0, 0.0, 0.0),
            up_direction=(0.0, -1.0, 0.0),
        )

    def press(self, viewer_page, label, value=True):
        """A button, or another control with its value."""
        handles = list(viewer_page._server.gui._gui_input_handle_from_uuid.values())
        for handle in handles:
            if getattr(handle, "label", None) == label:
                uuid = handle._impl.uuid
                self.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})
                return
        raise KeyError(label)

    def receive(self, seconds):
        """Take what comes within `seconds`; keeps the newest image and Gaussians."""
        with contextlib.suppress(TimeoutError):
            while True:
                message = self._socket.recv(timeout=seconds)
                length = int.from_bytes(message[8:16], "little")
                table = zstandard.ZstdDecompressor().decompress(message[16:][:length])
                table = msgspec.msgpack.decode(table)
                place, buffers = 16 + length, []
                for size in table["binaryBufferLengths"]:
                    place += -place % 8
                    buffers.append(message[place : place + size])
                    place += size
                for each in table["messages"]:
                    self._take(each, buffers)

    def _take(self, message, buffers):
        if message.get("rgb_data"):
            image = PIL.Image.open(io.BytesIO(message["rgb_data"]))
            self.image = np.asarray(image)
        updates = message.get("props") or message.get("updates") or {}
        buffer = updates.get("buffer")
        if isinstance(buffer, dict):
            words = np.frombuffer(buffers[buffer["__binary_index"]], np.uint32)
            self.splats = words.reshape(-1, 8)

    def positions(self):
        """Centers of the Gaussians, in viser's unit."""
        return self.splats[:, :3].copy().view(np.float32)


@contextlib.contextmanager
def opened(tmp_path, kind="gaussians", **options):
    """A page of a run, a browser, and `until(true)`, which serves until it is."""
    run, state = a_run(kind)
    page = viewer.Viewer(run, (160, 120), 8180, tmp_path, **options)
    browser = Browser(page.address)

    def until(what):
        for _ in range(400):
            page.serve(state, 0, 0.2)
            browser.receive(0.05)
            if what():
                return
        raise TimeoutError

    try:
        yield page, browser, until, run, state
    finally:
        browser.close()
        page.close()


def label_of(page, start):
    """The label of the control whose label begins so; None where there is none."""
    handles = list(page._server.gui._gui_input_handle_from_uuid.values())
    labels = [getattr(handle, "label", None) or "" for handle in handles]
    return next((label for label in labels if label.startswith(start)), None)


@pytest.mark.slow
def test_a_browser_gets_gaussians_that_follow_time_effects_and_the_channel(tmp_path):
    rows = [int(row) for row in CAPTURE.train[:2]]
    with opened(tmp_path) as (page, browser, until, _, state):
        assert page.address.startswith("http://127.0.0.1:")
        browser.look(eye_of(rows[0]))
        until(lambda: browser.splats is not None)
        first = browser.positions()
        look = Look(float(np.round(CAPTURE.times[rows[0]], 3)))
        cloud = page.screen.splats(state, eye_of(rows[0]), look)
        # viser is told of them in a unit of its own
        unit = page._windows[0]._splat_unit
        np.testing.assert_allclose(first * unit, cloud.centers, rtol=1e-5, atol=1e-6)
        assert len(first) == len(cloud.centers)
        # What is behind them is one color.
        assert browser.image.shape == (8, 8, 3)
        browser.press(page, "time", 0.9)
        until(lambda: (browser.positions() != first).any())
        browser.press(page, "motion", False)
        browser.splats = browser.splats * 0
        until(lambda: browser.splats.any())
        frozen = browser.positions()
        browser.press(page, "time", 0.1)
        time.sleep(0.2)
        until(lambda: page._time.value == 0.1)
        until(lambda: not page._update(state, 0))
        np.testing.assert_array_equal(browser.positions(), frozen)
        # Depth is rendered here, by another program, and sharpens by itself.
        texts, tell = [], page._windows[0]._show_text
        page._windows[0]._show_text = lambda text: texts.append(text) or tell(text)
        browser.press(page, "show", "depth")
        until(lambda: browser.image is not None and browser.image.shape[1] == 160)
        assert texts[0].startswith("Compiling")
        assert texts[-1].startswith("160x120")
        assert not page._windows[0]._splats.visible
        browser.press(page, "show", "color")
        until(lambda: browser.image.shape == (8, 8, 3))
        assert page._windows[0]._splats.visible


@pytest.mark.slow
def test_a_tab_that_is_closed_in_the_middle_of_an_update_leaves_no_warning(
    tmp_path, monkeypatch, caplog
):
    with opened(tmp_path) as (page, browser, until, _, state):
        browser.look(eye_of(int(CAPTURE.train[0])))
        until(lambda: browser.splats is not None)
        evaluate = page.screen.splats

        def leaving(*inputs):
            browser.close()
            while page._server.get_clients():
                time.sleep(0.01)
            return evaluate(*inputs)

        monkeypatch.setattr(page.screen, "splats", leaving)
        page._time.value = 0.9
        with warnings.catch_warnings(), caplog.at_level("WARNING"):
            warnings.simplefilter("error")
            for _ in range(3):
                page.serve(state, 0, 0.2)
        assert not page._windows
        assert not caplog.records


@pytest.mark.slow
def test_images_of_a_field_reach_full_size_however_slow_they_are(tmp_path, monkeypatch):
    """Under load a coarse image can take so long that a finer one seems hopeless."""
    from nerfies_jax.runs import viewer_window

    monkeypatch.setattr(screen, "TRACED_PIXELS", 400)
    monkeypatch.setattr(screen.Screen, "tile_seconds", lambda *_: 30.0)
    monkeypatch.setattr(viewer_window, "PARTIAL_SECONDS", 0.0)
    row = int(CAPTURE.train[0])
    with opened(tmp_path, "radiance") as (page, browser, until, run, state):
        assert run.representation.products.splatting is None
        browser.look(eye_of(row))
        until(lambda: browser.image is not None)
        assert browser.image.shape[1] < 160
        until(lambda: browser.image.shape[1] == 160)
        until(lambda: not page._update(state, 0))
        browser.receive(0.2)
        view = evaluation.resized(
            evaluation.view_of(CAPTURE, row), CAPTURE.size, (160, 120)
        )
        expected = evaluation.Renderer(run.model, (160, 120))(state, view).color
        # JPEG of quality 90
        assert np.abs(browser.image - 255.0 * expected.clip(0, 1)).mean() < 4


@pytest.mark.slow
def test_a_path_is_edited_saved_loaded_and_rendered(tmp_path, capsys):
    rows = [int(row) for row in CAPTURE.train[:3]]
    with opened(tmp_path) as (page, browser, until, _, _):
        frames = page.path.keyframes

        def add(row, time, count):
            browser.look(eye_of(row))
            browser.press(page, "time", time)
            browser.press(page, "add keyframe")
            # What is clicked counts, however the camera moves before it is dealt with.
            browser.look(eye_of(int(CAPTURE.train[-1])))
            browser.press(page, "time", 0.77)
            until(lambda: len(frames) == count)

        for count, (row, time) in enumerate(
            zip(rows, (0.0, 0.5, 0.25), strict=True), 1
        ):
            add(row, time, count)
        positions = [keyframe.camera.position for keyframe in frames]
        np.testing.assert_allclose(positions, CAPTURE.cameras.position[rows], atol=1e-5)
        assert [keyframe.time for keyframe in frames] == [0.0, 0.5, 0.25]
        browser.press(page, label_of(page, "2: "), "↓")
        until(lambda: frames[2].time == 0.5)
        browser.press(page, label_of(page, "1: "), "✕")
        until(lambda: len(frames) == 2)
        shown = len(page.path._handles)
        browser.press(page, "show path", False)
        until(lambda: len(page.path._handles) == 0 < shown)
        browser.press(page, "seconds", 0.2)
        browser.press(page, "save")
        saved = tmp_path / "exports" / "path-1.json"
        until(saved.exists)
        browser.press(page, label_of(page, "1: "), "set")
        until(lambda: frames[0].time == 0.77)
        path = path_files.named(str(saved), CAPTURE, None)
        ends = [0, -1]
        assert path.size == CAPTURE.size
        np.testing.assert_allclose(path.times[ends], [0.25, 0.5], atol=1e-3)
        expected = CAPTURE.cameras.position[[rows[2], rows[1]]]
        np.testing.assert_allclose(path.cameras.position[ends], expected, atol=1e-5)
        page._tasks.put(lambda: page.path._load(None, None, None, saved.read_bytes()))
        until(lambda: page.path.keyframes[0].time == 0.25)
        browser.press(page, "preview")
        until(lambda: page._time.value == page.path.keyframes[-1].time)
        until(lambda: page.path._preview is None)
        browser.press(page, "render")
        out = tmp_path / "renders" / "path-1"
        until(out.exists)
        assert len(list(out.glob("*.png"))) == 5  # of 0.2 s
        assert page.path.rendering is None
        browser.press(page, "render")
        until(lambda: page.path.rendering is not None)
        browser.press(page, "cancel rendering")
        until(lambda: page.path.rendering is None)
        assert [each.name for each in out.parent.iterdir()] == ["path-1"]
    assert f"--path {saved}" in capsys.readouterr().out


@pytest.mark.slow
def test_training_waits_while_it_is_paused_and_never_for_nobody(tmp_path, monkeypatch):
    monkeypatch.setattr(viewer_training, "ABSENT_SECONDS", 1.0)
    run, state = a_run("gaussians")
    with contextlib.ExitStack() as held:
        page = viewer.Viewer(run, (160, 120), 8480, tmp_path, in_training=True)
        held.callback(page.close)
        monkeypatch.setattr(viewer, "Viewer", lambda *_, **__: page)
        hook = held.enter_context(viewer.live(run, tmp_path, 8480))
        browser = Browser(page.address)
        held.callback(browser.close)
        browser.look(eye_of(int(CAPTURE.train[0])))

        def chunk(step):
            """What the loop does between two chunks, in a thread of its own."""
            metrics = {"loss": 1.0 / step}
            called = threading.Thread(target=hook.call, args=(state, step, metrics))
            called.start()
            return called

        chunk(1).join(120)
        browser.press(page, "pause training")
        time.sleep(0.3)  # until the server's thread has read it
        paused = chunk(2)
        paused.join(2)
        assert paused.is_alive()
        browser.press(page, "resume training")
        paused.join(60)
        assert not paused.is_alive()
        # A tab that is closed pauses nothing, and Ctrl-C ends what is paused.
        browser.press(page, "pause training")
        time.sleep(0.3)
        paused = chunk(3)
        browser.close()
        paused.join(60)
        assert not paused.is_alive()
        assert page.training._losses == [1.0, 0.5, 1 / 3]
        page.training.paused = True
        monkeypatch.setattr(viewer_training, "ABSENT_SECONDS", 1000.0)
        paused = chunk(4)
        with stopping.StopRequests() as requests:
            requests._note(signal.SIGINT, None)
            paused.join(60)
        assert not paused.is_alive()


@pytest.mark.slow
def test_who_looks_on_changes_nothing_of_what_is_learned(tmp_path, capsys):
    run, state = a_run("gaussians")
    frames = evaluation.frames_of(CAPTURE, run.model.required_data)
    alone = loop.fit(run.model, state, frames, steps=3)
    with viewer.live(run, tmp_path, 8190) as hook:
        address = re.search(r"during training: (\S+)", capsys.readouterr().out)[1]
        browser = Browser(address)
        try:
            browser.look(eye_of(int(CAPTURE.train[0])))
            time.sleep(0.5)  # until the server's thread has read it
            seen = loop.fit(run.model, state, frames, steps=3, hooks=[hook])
            browser.receive(0.5)
        finally:
            browser.close()
    assert len(browser.splats)
    assert seen.stopped_by == "steps"
    for one, other in zip(
        *(jax.tree.leaves(each.state.params) for each in (alone, seen)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_without_viser_one_line_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ValueError, match=r"pip install 'nerfies-jax\[view\]'"):
        viewer.check_installed()
