"""The player's page against the model: unpacked here, projected by its own program."""

import base64
import dataclasses
import functools
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import representation
from gaussians_jax.core import splats
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Gaussians
from gaussians_jax.io import keyframes
from gaussians_jax.player import packing
from gaussians_jax.player import page as player_page
from gaussians_jax.scene import scene
from gaussians_jax.splatting import projection, rendering
from nerfies_jax import evaluation
from nerfies_jax.geometry import camera as cameras
from tests import scenes
from tests.gaussians.browser import by_node, image_of, launched, needs_node, program_of
from tests.gaussians.shared import jitted, put

BEHIND = 7  # Gaussians that no camera can see
SPEC = dataclasses.replace(scenes.TINY_SPLATS, sh_degree=0)


def swing(params, gaussians, condition, ready):
    """Everything to the right of the middle rises, turns and fades; nothing else."""
    del params, ready
    right = gaussians.mean[:, :1] > 0
    time = condition.time
    rise = jnp.asarray([0.02, -0.15, 0.05], gaussians.mean.dtype) * jnp.sin(3 * time)
    turn = jnp.where(right, jnp.asarray([0.3, -0.5, 1.0], time.dtype) * time, 0)
    return gaussians._replace(
        mean=gaussians.mean + jnp.where(right, rise, 0),
        quaternion=splats.rotate(gaussians, turn),
        opacity=gaussians.opacity * jnp.where(right[:, 0], 1 - time / 2, 1),
    )


@functools.cache
def moving_scene():
    """A scene whose Gaussians are long, colored, moving, or behind everyone."""
    capture = scenes.tiny_capture()
    model = scene.build(
        SPEC, scene.metadata_of(capture), (SplatRecord("swing", deform=swing),)
    )
    state = model.init(capture, jax.random.key(0))
    rows = state.params.rows["splats"]
    rng = np.random.default_rng(0)
    active = np.asarray(splats.active_mask(rows))
    behind = capture.cameras.position[0] - 5 * capture.cameras.camera_from_world[0, 2]
    mean = np.array(rows.mean)
    mean[np.nonzero(active)[0][:BEHIND]] = behind
    rows = rows._replace(
        mean=mean,
        log_scale=rows.log_scale + rng.uniform(-1, 1, rows.log_scale.shape),
        quaternion=rng.normal(size=rows.quaternion.shape),
        opacity_logit=np.where(active, 2.0, rows.opacity_logit),
        sh_dc=rng.normal(size=rows.sh_dc.shape),
    )
    rows = put(rows, "float32")
    params = state.params._replace(rows={"splats": rows})
    return model, state._replace(params=params), capture


@functools.cache
def render(row, time):
    """The model's image from a camera of the capture."""
    _, state, capture = moving_scene()
    view = evaluation.view_of(capture, row)._replace(time=jnp.asarray(time, "float32"))
    return renderer()(state, view).color


@functools.cache
def renderer():
    model, _, capture = moving_scene()
    return evaluation.Renderer(model, capture.size)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("player") / "player.html"
    model, state, capture = moving_scene()
    poster = evaluation.to_uint8(render(0, 0.0))
    title = "</script>{{data}}"
    written = representation.player(path, title, SPEC, model, state, capture, poster)
    assert written.path == path
    return path


def inside(page, name):
    return re.search(rf'id="{name}">([^<]*)<', page.read_text())[1]


def unpacked(page, time):
    """Gaussians and colors at a time, by the header alone."""
    header = json.loads(inside(page, "header"))
    data = base64.b64decode(inside(page, "data"))
    arrays = {}
    for name, entry in header["arrays"].items():
        count = int(np.prod(entry["shape"]))
        stored = np.frombuffer(data, entry["type"], count, entry["offset"])
        value = entry["shift"] + entry["scale"] * stored.astype(float)
        arrays[name] = value.reshape(entry["shape"])
    place = time * (header["keyframes"] - 1)
    first = min(int(place), header["keyframes"] - 2)
    now = {}
    for name in ("mean", "quaternion", "log_scale", "opacity"):
        rows = arrays[f"{name}.rows"].astype(int)
        before, after = arrays[f"{name}.change"][first : first + 2]
        between = before + (place - first) * (after - before)
        now[name] = arrays[name].copy()
        now[name][rows] += arrays[f"{name}.step"][:, None] * between
    leaves = now["mean"], now["quaternion"], np.exp(now["log_scale"]), now["opacity"]
    leaves = (*leaves[:3], leaves[3][:, 0])
    return put(Gaussians(*leaves), "float32"), put(arrays["color"], "float32")


def psnr(one, other):
    return -10 * np.log10(np.mean((np.clip(one, 0, 1) - np.clip(other, 0, 1)) ** 2))


@functools.cache
def compiled_render():
    capture = moving_scene()[2]
    background = jnp.asarray(capture.background or (0, 0, 0), jnp.float32)
    return jitted(
        lambda gaussians, colors, camera: (
            rendering.render(
                gaussians, colors, camera, capture.size, SPEC.raster, background
            ).rendering.color
        )
    )


@pytest.mark.parametrize("time", [0.0, 0.5, 1.0])
def test_what_is_in_the_page_draws_as_the_model_does(page, time):
    _, state, capture = moving_scene()
    gaussians, colors = unpacked(page, time)
    for row in capture.heldout:
        view = evaluation.view_of(capture, row)
        image = compiled_render()(gaussians, colors, view.camera)
        # 73 dB at an instant; halfway between two, 64: a straight line for an arc.
        assert psnr(image, render(int(row), time)) > 60
    active = int(splats.active_mask(state.params.rows["splats"]).sum())
    assert len(colors) <= active - BEHIND


def test_a_scene_too_large_for_a_page_gets_fewer_instants(tmp_path, monkeypatch):
    model, state, capture = moving_scene()
    monkeypatch.setattr(packing, "pack", pack := Packing(packing.pack))
    monkeypatch.setattr(player_page, "MOST_BYTES", 12_000)
    path, poster = tmp_path / "player.html", np.zeros((30, 40, 3), np.uint8)
    representation.player(path, "", SPEC, model, state, capture, poster)
    assert pack.keyframes[0] == keyframes.LEAST_KEYFRAMES
    assert player_page.FEWEST_KEYFRAMES <= pack.keyframes[1] < pack.keyframes[0]
    header = json.loads(inside(path, "header"))
    assert header["keyframes"] == pack.keyframes[1]


class Packing:
    """Packs, and remembers how many keyframes there were."""

    def __init__(self, pack):
        self._pack, self.keyframes = pack, []

    def __call__(self, gaussians, still):
        self.keyframes.append(len(gaussians.mean))
        return self._pack(gaussians, still)


def test_one_rotation_keeps_one_sign():
    angle = np.linspace(0, 3 * np.pi, 30)  # to and fro over the double cover
    true = np.stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle], -1)[:, None]
    flipped = true * np.where(np.arange(30) % 3 == 0, -2, 1)[:, None, None]
    quaternions = keyframes.steady(flipped)
    np.testing.assert_allclose(quaternions, -true, atol=1e-12)


ORDER = """
const [program, page, cameras] = JSON.parse(require("fs").readFileSync(0, "utf8"));
const f = new Function(program + "; return { order, sorterOf }")();
const data = Uint8Array.from(Buffer.from(page.data, "base64")).buffer;
const sort = f.sorterOf(page.header, data);
console.log(JSON.stringify({
  order: Array.from(f.order(Float32Array.from([3, 1e-30, 70000, 3, 2.5, 1e9, 2.5]))),
  rows: cameras.map((camera) => Array.from(sort(camera))),
}));
"""


@needs_node
def test_the_page_sorts_what_is_ahead_from_the_farthest_on(page):
    capture = moving_scene()[2]
    views = [(2, 0.9), (0, 0.3), (2, 0.3)]  # and back: nothing of a time before stays
    requests = []
    for row, time in views:
        forward = capture.cameras.camera_from_world[row, 2].tolist()
        position = capture.cameras.position[row].tolist()
        requests.append({"position": position, "forward": forward, "time": time})
    header = json.loads(inside(page, "header"))
    header["raster"]["near"] = 0.55  # so that some Gaussians are nearer
    content = {"header": header, "data": inside(page, "data")}
    answer = by_node(ORDER, program_of("splats.js"), content, requests)
    assert answer["order"] == [1, 4, 6, 0, 3, 2, 5]
    for view, rows in zip(requests, answer["rows"], strict=True):
        mean = np.asarray(unpacked(page, view["time"])[0].mean, float)
        depth = (mean - view["position"]) @ view["forward"]
        assert sorted(rows) == np.nonzero(depth >= 0.55)[0].tolist()
        assert 100 < len(rows) < len(depth)
        assert (np.diff(depth[rows]) < 1e-6).all()


def odd_camera():
    """A camera of which nothing is as usual."""
    return cameras.take(moving_scene()[2].cameras, 2)._replace(
        principal_point_px=np.float32([23, 11]),
        pixel_aspect=np.float32(1.3),
        skew_px=np.float32(4),
    )


# Runs the page's own projection over all Gaussians, and reads what it computes.
FOOTPRINTS = """([camera, time, antialiased]) => {
  const { gl, scene } = player.painter;
  const raster = { ...HEADER.raster, antialiased, near: 0.55 };
  const names = ["mean", "whitening", "opacity", "color", "seen"];
  const program = programOf(gl, `#version 300 es
    ${PROJECTION}
    out vec2 mean; out vec3 whitening, color; out float opacity, seen;
    void main() {
      Footprint shown = footprintOf(gl_VertexID);
      seen = float(shown.seen);
      if (shown.seen) {
        mean = shown.mean; whitening = shown.whitening;
        opacity = shown.opacity; color = shown.color;
      }
    }`, `#version 300 es
    void main() {}`, names);
  const count = HEADER.arrays.color.shape[0], bytes = 4 * 10 * count;
  gl.bindVertexArray(gl.createVertexArray());
  gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, gl.createBuffer());
  gl.bufferData(gl.TRANSFORM_FEEDBACK_BUFFER, bytes, gl.STATIC_READ);
  gl.useProgram(program);
  setCamera(uniformsOf(gl, program), scene, camera, raster, time);
  gl.enable(gl.RASTERIZER_DISCARD);
  gl.beginTransformFeedback(gl.POINTS);
  gl.drawArrays(gl.POINTS, 0, count);
  gl.endTransformFeedback();
  const read = new Float32Array(10 * count);
  gl.getBufferSubData(gl.TRANSFORM_FEEDBACK_BUFFER, 0, read);
  return Array.from(read);
}"""


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_page_projects_as_the_library(opened, page, antialiased):
    one = odd_camera()
    size = moving_scene()[2].size
    gaussians, colors = unpacked(page, 0.3)
    # Some Gaussians are nearer than this.
    raster = dataclasses.replace(SPEC.raster, antialiased=antialiased, near=0.55)
    expected = jitted(projection.project, static_argnums=(2, 3))(
        gaussians, put(one, "float32"), size, raster
    )
    camera = {
        "rotation": one.camera_from_world.ravel().tolist(),
        "position": one.position.tolist(),
        "focal": float(one.focal_px),
        "aspect": float(one.pixel_aspect),
        "skew": float(one.skew_px),
        "center": one.principal_point_px.tolist(),
        "size": size,
    }
    program = FOOTPRINTS.replace("HEADER", inside(page, "header"))
    table = np.reshape(opened.evaluate(program, [camera, 0.3, antialiased]), (-1, 10))
    shown = np.asarray(expected.extent_px[:, 0] > 0)
    np.testing.assert_array_equal(table[:, 9] == 1, shown)
    assert 100 < shown.sum() < len(shown)
    parts = (expected.mean_px, expected.whitening, expected.opacity[:, None], colors)
    exact = np.concatenate([np.asarray(part)[shown] for part in parts], axis=1)
    # Both are float32. Gaussians near the camera plane are thousands of px away.
    np.testing.assert_allclose(table[shown, :9], exact, rtol=2e-3, atol=2e-3)


@pytest.fixture(scope="module")
def browser():
    yield from launched()


@pytest.fixture
def opened(browser, page):
    """The page in a browser, its canvas as large as the images of the capture."""
    tab = browser.new_page(viewport={"width": 600, "height": 400})
    tab.goto(page.as_uri() + "#t=0")
    tab.add_style_tag(
        content="#stage { flex: none !important; width: 40px; height: 30px }"
    )
    yield tab
    tab.close()


@pytest.mark.parametrize("time", [0.0, 1.0])
def test_a_browser_draws_what_the_model_does(opened, time):
    opened.get_by_label("Time", exact=True).fill(str(time))
    opened.wait_for_function("(time) => player.ready && player.time === time", arg=time)
    image = image_of(opened)
    assert image.shape == (30, 40, 3)
    assert psnr(image, render(0, time)) > 50  # 8 bits alone leave 59
    assert psnr(image, render(0, 1.0 - time)) < 30


@pytest.mark.full
def test_what_moves_does_not_hide_what_stands_behind_it():
    """The thing behind keeps a color of its own, though no view shows it."""
    capture = scenes.tiny_capture()
    camera = jax.tree.map(lambda leaf: leaf[capture.train[0]], capture.cameras)
    ahead = camera.position + np.outer([0.4, 0.8], camera.camera_from_world[2])
    mean = np.concatenate([np.repeat(ahead[:1], 9, axis=0), ahead[1:]])
    rows = splats.from_points(mean, np.full((10, 3), 0.25), degree=0)
    moves = np.arange(10) < 9
    scale = np.where(moves, 1.0, 0.02)  # sheets that fill every image
    opacity = put(np.where(moves, 0.95, 0.9), "float32")

    def at(time):
        shifted = rows.mean + np.where(moves, 0.1 * time, 0)[:, None] * [1, 0, 0]
        scales = put(np.repeat(scale[:, None], 3, 1), "float32")
        return Gaussians(put(shifted, "float32"), rows.quaternion, scales, opacity)

    seen = keyframes.measure_contributions(
        at, rows, SPEC.raster, jnp.asarray(0), capture
    )
    assert seen.most[9] > keyframes.LEAST_SEEN_PX
    np.testing.assert_allclose(seen.color[9], 0.25, atol=1e-5)
