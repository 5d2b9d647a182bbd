"""A page to look around in: the browser's side of it, without a browser."""

import contextlib
import io
import re
import sys
import time

import jax
import msgspec
import numpy as np
import PIL.Image
import pytest
from scipy.spatial.transform import Rotation

from nerfies_jax import evaluation, runs
from nerfies_jax.capture import path_files
from nerfies_jax.evaluation.interactive import Eye, Look
from nerfies_jax.runs import representations, screen, viewer
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.training import loop
from tests import scenes

viser = pytest.importorskip("viser")
zstandard = pytest.importorskip("zstandard")  # which viser brings along
CAPTURE = scenes.tiny_capture()
SPECS = {"gaussians": scenes.TINY_DEFORMABLE, "radiance": scenes.TINY_FIELD}


def a_run(kind):
    """A run of the tiny capture, and its state, in which something moves."""
    config = RunConfig("splats-static-small", CaptureSource())
    run = runs.open_run(config, representations.named(kind), SPECS[kind], CAPTURE)
    state, rng = runs.first_state(run), np.random.default_rng(0)

    def shake(leaf):
        return leaf + np.asarray(0.1 * rng.normal(size=leaf.shape), leaf.dtype)

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
    """Where a frame was filmed from, as viser tells it."""
    one = jax.tree.map(lambda leaf: leaf[row], CAPTURE.cameras)
    turn = Rotation.from_matrix(one.camera_from_world.T)
    return Eye(
        tuple(turn.as_quat(scalar_first=True).tolist()),
        tuple(one.position.tolist()),
        2 * float(np.arctan2(CAPTURE.size[1] / 2, one.focal_px * one.pixel_aspect)),
        CAPTURE.size[0] / CAPTURE.size[1] * float(one.pixel_aspect),
    )


@pytest.mark.parametrize(
    "kind", ["gaussians", pytest.param("radiance", marks=pytest.mark.full)]
)
def test_a_screen_draws_what_the_renderer_draws_and_without_effects(kind):
    run, state = a_run(kind)
    shown = screen.Screen(run, CAPTURE.size)
    row = int(CAPTURE.train[0])
    first = Look(float(CAPTURE.times[row]), appearance=int(CAPTURE.appearance_ids[row]))
    picture = shown.draw(state, eye_of(row), first, 0)
    renderer = evaluation.Renderer(run.model, CAPTURE.size)
    expected = renderer(state, evaluation.view_of(CAPTURE, row)).colour
    difference = picture - 255.0 * expected.clip(0, 1)
    # 8 bits round by half; the pose went through a quaternion
    assert np.abs(difference).mean() < 0.6
    assert shown.seconds(first)[0] > 0
    later = first._replace(time=0.9)
    name = {"gaussians": "motion", "radiance": "warp"}[kind]
    assert name in shown.parts.removable
    frozen = [
        shown.draw(state, eye_of(row), look._replace(without=(name,)), 0)
        for look in (first, later)
    ]
    np.testing.assert_array_equal(*frozen)
    assert (shown.draw(state, eye_of(row), later, 0) != picture).any()
    # How far things moved since time 0: nothing at 0, something later.
    dark, bright = (
        shown.draw(state, eye_of(row), Look(time, "motion"), 0) for time in (0.0, 0.9)
    )
    known = (dark != 128).any(axis=-1)
    assert known.sum() > 50
    assert dark[known].max() < 10 < bright[known].max()
    varied = shown.draw(state, eye_of(row), first._replace(appearance=1), 0)
    assert (varied != picture).any() == (kind == "radiance")


class Browser:
    """What a browser sends, and what it gets."""

    def __init__(self, address):
        from websockets.sync.client import connect

        self._socket = connect(
            address.replace("http", "ws"),
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
        )
        self.picture, self.uuids = None, {}

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
        for handle in viewer_page._server.gui._gui_input_handle_from_uuid.values():
            if handle.label == label:
                uuid = handle._impl.uuid
                self.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})
                return
        raise KeyError(label)

    def receive(self, seconds):
        """Take what comes within `seconds`; keeps the newest background picture."""
        with contextlib.suppress(TimeoutError):
            while True:
                message = self._socket.recv(timeout=seconds)
                length = int.from_bytes(message[8:16], "little")
                table = zstandard.ZstdDecompressor().decompress(message[16:][:length])
                for each in msgspec.msgpack.decode(table)["messages"]:
                    if each.get("rgb_data"):
                        picture = PIL.Image.open(io.BytesIO(each["rgb_data"]))
                        self.picture = np.asarray(picture)


@pytest.mark.slow
def test_a_browser_gets_pictures_and_leaves_a_path_to_render(tmp_path, capsys):
    run, state = a_run("gaussians")
    page = viewer.Viewer(run, (160, 120), 8180, tmp_path / "exports")
    browser = Browser(page.address)
    try:
        assert page.address.startswith("http://127.0.0.1:")

        def until(what):
            for _ in range(200):
                page.serve(state, 0, 0.2)
                browser.receive(0.05)
                if what():
                    return
            raise TimeoutError

        rows = [int(row) for row in CAPTURE.train[:2]]
        browser.look(eye_of(rows[0]))
        # Sharpens by itself.
        until(lambda: browser.picture is not None and browser.picture.shape[1] == 160)
        first = browser.picture
        view = evaluation.resized(
            evaluation.view_of(CAPTURE, rows[0]), CAPTURE.size, (160, 120)
        )
        expected = evaluation.Renderer(run.model, (160, 120))(state, view).colour
        # JPEG of quality 90
        assert np.abs(first - 255.0 * expected.clip(0, 1)).mean() < 4
        browser.press(page, "add keyframe")
        until(lambda: len(page.keyframes) == 1)
        browser.picture = None
        browser.look(eye_of(rows[1]))
        browser.press(page, "time", 0.5)
        until(lambda: browser.picture is not None and browser.picture.shape[1] == 160)
        assert (browser.picture != first).any()
        browser.press(page, "add keyframe")
        until(lambda: len(page.keyframes) == 2)
        browser.press(page, "save")
        saved = tmp_path / "exports" / "path-1.json"
        until(saved.exists)
    finally:
        browser.close()
        page.close()
    path = path_files.named(str(saved), CAPTURE, None)
    assert path.size == CAPTURE.size
    ends = [0, -1]
    np.testing.assert_allclose(
        path.times[ends], [CAPTURE.times[rows[0]], 0.5], atol=1e-3
    )
    np.testing.assert_allclose(
        path.cameras.position[ends], CAPTURE.cameras.position[rows], atol=1e-5
    )
    assert f"--path {saved}" in capsys.readouterr().out


@pytest.mark.slow
def test_who_looks_on_changes_nothing_of_what_is_learnt(tmp_path, capsys):
    run, state = a_run("gaussians")
    frames = evaluation.frames_of(CAPTURE, run.model.required_data)
    alone = loop.fit(run.model, state, frames, steps=3)
    with viewer.live(run, tmp_path, 8190) as hook:
        address = re.search(r"trains: (\S+)", capsys.readouterr().out)[1]
        browser = Browser(address)
        try:
            browser.look(eye_of(int(CAPTURE.train[0])))
            time.sleep(0.5)  # until the server's thread has read it
            seen = loop.fit(run.model, state, frames, steps=3, hooks=[hook])
            browser.receive(0.5)
        finally:
            browser.close()
    assert browser.picture.shape == (*CAPTURE.size[::-1], 3)
    assert seen.stopped_by == "steps"
    for one, other in zip(
        *(jax.tree.leaves(each.state.params) for each in (alone, seen)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_without_viser_one_line_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ValueError, match=r"pip install 'nerfies-jax\[view\]'"):
        viewer.check_installed()
