"""The player's page against the model: unpacked here, projected by its own program."""

import base64
import dataclasses
import functools
import json
import pathlib
import re
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import projection, rendering, representation, scene, splats
from gaussians_jax.player import packing, sampled
from gaussians_jax.player import page as player_page
from gaussians_jax.splats import Gaussians
from nerfies_jax import evaluation
from nerfies_jax.capture import images
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training.effects import Effect
from tests import scenes
from tests.gaussians.shared import jitted, put

BEHIND = 7  # Gaussians that no camera can see
SPEC = dataclasses.replace(scenes.TINY_SPLATS, sh_degree=0)
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
needs_node = pytest.mark.skipif(not shutil.which("node"), reason="no node here")


def swing(params, gaussians, condition, ready):
    """Everything to the right of the middle rises, turns and fades; nothing else."""
    del params, ready
    right = gaussians.mean[:, :1] > 0
    time = condition.time
    rise = jnp.asarray([0.02, -0.15, 0.05], gaussians.mean.dtype) * jnp.sin(3 * time)
    turn = jnp.where(right, jnp.asarray([0.3, -0.5, 1.0], time.dtype) * time, 0)
    return gaussians._replace(
        mean=gaussians.mean + jnp.where(right, rise, 0),
        quaternion=splats.turned(gaussians, turn),
        opacity=gaussians.opacity * jnp.where(right[:, 0], 1 - time / 2, 1),
    )


@functools.cache
def moving_scene():
    """A scene whose Gaussians are long, coloured, moving, or behind everyone."""
    capture = scenes.tiny_capture()
    model = scene.build(
        SPEC, scene.metadata_of(capture), (Effect("swing", deform=swing),)
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
def drawn(row, time):
    """The model's picture from a camera of the capture."""
    _, state, capture = moving_scene()
    view = evaluation.view_of(capture, row)._replace(time=jnp.asarray(time, "float32"))
    return renderer()(state, view).colour


@functools.cache
def renderer():
    model, _, capture = moving_scene()
    return evaluation.Renderer(model, capture.size)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("player") / "player.html"
    model, state, capture = moving_scene()
    poster = evaluation.as_picture(drawn(0, 0.0))
    title = "</script>{{data}}"
    written = representation.player(path, title, SPEC, model, state, capture, poster)
    assert written.path == path
    return path


def inside(page, name):
    return re.search(rf'id="{name}">([^<]*)<', page.read_text())[1]


def unpacked(page, time):
    """Gaussians and colours at a time, by the header alone."""
    header = json.loads(inside(page, "header"))
    data = base64.b64decode(inside(page, "data"))
    arrays = {}
    for name, entry in header["arrays"].items():
        count = int(np.prod(entry["shape"]))
        stored = np.frombuffer(data, entry["type"], count, entry["offset"])
        value = entry["shift"] + entry["scale"] * stored.astype(float)
        arrays[name] = value.reshape(entry["shape"])
    place = time * (header["instants"] - 1)
    first = min(int(place), header["instants"] - 2)
    now = {}
    for name in ("mean", "quaternion", "log_scale", "opacity"):
        rows = arrays[f"{name}.rows"].astype(int)
        before, after = arrays[f"{name}.change"][first : first + 2]
        between = before + (place - first) * (after - before)
        now[name] = arrays[name].copy()
        now[name][rows] += arrays[f"{name}.step"][:, None] * between
    leaves = now["mean"], now["quaternion"], np.exp(now["log_scale"]), now["opacity"]
    leaves = (*leaves[:3], leaves[3][:, 0])
    return put(Gaussians(*leaves), "float32"), put(arrays["colour"], "float32")


def psnr(one, other):
    return -10 * np.log10(np.mean((np.clip(one, 0, 1) - np.clip(other, 0, 1)) ** 2))


@functools.cache
def compiled_render():
    capture = moving_scene()[2]
    background = jnp.asarray(capture.background or (0, 0, 0), jnp.float32)
    return jitted(
        lambda gaussians, colours, camera: (
            rendering.render(
                gaussians, colours, camera, capture.size, SPEC.raster, background
            ).rendering.colour
        )
    )


@pytest.mark.parametrize("time", [0.0, 0.5, 1.0])
def test_what_is_in_the_page_draws_as_the_model_does(page, time):
    _, state, capture = moving_scene()
    gaussians, colours = unpacked(page, time)
    for row in capture.heldout:
        view = evaluation.view_of(capture, row)
        picture = compiled_render()(gaussians, colours, view.camera)
        # 73 dB at an instant; halfway between two, 64: a straight line for an arc.
        assert psnr(picture, drawn(int(row), time)) > 60
    active = int(splats.active_mask(state.params.rows["splats"]).sum())
    assert len(colours) <= active - BEHIND


def test_a_scene_too_large_for_a_page_gets_fewer_instants(tmp_path, monkeypatch):
    model, state, capture = moving_scene()
    monkeypatch.setattr(packing, "pack", pack := Packing(packing.pack))
    monkeypatch.setattr(player_page, "MOST_BYTES", 12_000)
    path, poster = tmp_path / "player.html", np.zeros((30, 40, 3), np.uint8)
    representation.player(path, "", SPEC, model, state, capture, poster)
    assert pack.instants[0] == sampled.LEAST_INSTANTS
    assert player_page.FEWEST_INSTANTS <= pack.instants[1] < pack.instants[0]
    header = json.loads(inside(path, "header"))
    assert header["instants"] == pack.instants[1]


class Packing:
    """Packs, and remembers how many instants there were."""

    def __init__(self, pack):
        self._pack, self.instants = pack, []

    def __call__(self, gaussians, still):
        self.instants.append(len(gaussians.mean))
        return self._pack(gaussians, still)


def test_one_rotation_keeps_one_sign():
    angle = np.linspace(0, 3 * np.pi, 30)  # to and fro over the double cover
    true = np.stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle], -1)[:, None]
    flipped = true * np.where(np.arange(30) % 3 == 0, -2, 1)[:, None, None]
    quaternions = sampled.steady(flipped)
    np.testing.assert_allclose(quaternions, -true, atol=1e-12)


PROJECT = """
const [program, page, camera, time] = JSON.parse(require("fs").readFileSync(0, "utf8"));
const names = "{unpack, pose, project, order, turned, moved, nearer, fitted}";
const f = new Function(program + "; return " + names)();
const data = Uint8Array.from(Buffer.from(page.data, "base64")).buffer;
const scene = f.unpack(page.header, data);
f.pose(scene, 0.9);
f.pose(scene, time);
const view = page.header.view, up = page.header.up;
console.log(JSON.stringify({
  footprints: [false, true].map((antialiased) => Array.from(
    f.project(scene, camera, { ...page.header.raster, antialiased }))),
  order: Array.from(f.order(Float32Array.from([3, 1e-30, 70000, 3, 2.5, 1e9, 2.5]))),
  turned: f.turned(f.turned(view, up, 0.4), view.rotation.slice(0, 3), -0.3),
  moved: f.moved(view, 0.2, 0.1),
  nearer: f.nearer(view, 0.5),
  fitted: f.fitted(view, 200, 90),
}));
"""


@pytest.fixture(scope="module")
def by_node(page):
    """What the page's own functions make of it, and with which camera and time."""
    capture = moving_scene()[2]
    one = cameras.take(capture.cameras, 2)._replace(
        principal_point_px=np.float32([23, 11]),
        pixel_aspect=np.float32(1.3),
        skew_px=np.float32(4),
    )
    camera = {
        "rotation": one.camera_from_world.ravel().tolist(),
        "position": one.position.tolist(),
        "focal": float(one.focal_px),
        "aspect": float(one.pixel_aspect),
        "skew": float(one.skew_px),
        "centre": one.principal_point_px.tolist(),
        "size": capture.size,
    }
    program = pathlib.Path(sampled.__file__).with_name("splats.js").read_text()
    content = {
        "header": json.loads(inside(page, "header")),
        "data": inside(page, "data"),
    }
    request = json.dumps([program, content, camera, 0.3])
    run = functools.partial(subprocess.run, capture_output=True, text=True, check=True)
    done = run(["node", "-e", PROJECT], input=request)
    return one, json.loads(done.stdout)


@needs_node
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_page_projects_as_the_library(page, by_node, antialiased):
    one, answer = by_node
    size = moving_scene()[2].size
    gaussians, colours = unpacked(page, 0.3)
    raster = dataclasses.replace(SPEC.raster, antialiased=antialiased)
    expected = jitted(projection.project, static_argnums=(2, 3))(
        gaussians, put(one, "float32"), size, raster
    )
    low, high = (expected.mean_px + sign * expected.extent_px for sign in (-1, 1))
    shown = (
        (expected.extent_px[:, 0] > 0)
        & (high > 0).all(1)
        & (low < np.array(size)).all(1)
    )
    parts = (
        expected.mean_px,
        expected.whitening,
        expected.opacity[:, None],
        expected.extent_px,
        colours,
    )
    exact = np.concatenate([np.asarray(part)[shown] for part in parts], axis=1)
    footprints = np.reshape(answer["footprints"][antialiased], (-1, 11))
    assert len(footprints) == len(exact) > 100
    places = [np.lexsort(table[:, :2].T.round(2)) for table in (footprints, exact)]
    one, other = footprints[places[0]], exact[places[1]]
    np.testing.assert_allclose(one, other, rtol=2e-3, atol=2e-3)  # 64 bits against 32
    depth = np.empty(len(exact))
    depth[places[0]] = expected.depth[shown][places[1]]
    assert (np.diff(depth) < 1e-6).all()  # the farthest first
    assert answer["order"] == [1, 4, 6, 0, 3, 2, 5]


@needs_node
def test_views_turn_about_their_target(page, by_node):
    _, answer = by_node
    view = json.loads(inside(page, "header"))["view"]
    target, start = np.array(view["target"]), np.array(view["position"])
    turned = answer["turned"]
    rotation = np.reshape(turned["rotation"], (3, 3))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    for one in (turned, answer["nearer"], answer["moved"]):
        rotation = np.reshape(one["rotation"], (3, 3))
        offset = np.array(one["target"]) - one["position"]
        away = np.linalg.norm(target - start) * (0.5 if one is answer["nearer"] else 1)
        np.testing.assert_allclose(rotation @ offset, [0, 0, away], atol=1e-6)
    moved = np.array(answer["moved"]["position"]) - start
    rotation = np.reshape(view["rotation"], (3, 3))
    np.testing.assert_allclose(rotation @ moved, [0.2, 0.1, 0], atol=1e-6)
    fitted = answer["fitted"]  # a picture of 40 x 30 in one of 200 x 90
    assert (fitted["enlarged"], fitted["size"]) == (3, [200, 90])
    assert fitted["focal"] == pytest.approx(3 * view["focal"])
    place = 3 * (np.array(view["centre"]) - (20, 15)) + (100, 45)
    np.testing.assert_allclose(fitted["centre"], place)


# The stage as large as the film, and the slider moved as by hand.
AT_END = """
<style>#stage { flex: none; width: 40px; height: 30px; }</style>
<script>
slider = document.getElementById("time");
slider.value = END;
slider.dispatchEvent(new Event("input"));
</script></body>"""


@pytest.mark.slow
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
@pytest.mark.parametrize("time", [0.0, 1.0])
def test_a_browser_draws_what_the_model_does(page, tmp_path, time):
    text = page.read_text().replace("</body>", AT_END.replace("END", str(time)))
    (tmp_path / "page.html").write_text(text)
    shot = tmp_path / "shot.png"
    options = ("--headless", "--no-sandbox", "--use-angle=swiftshader")
    options += ("--enable-unsafe-swiftshader", "--hide-scrollbars")
    options += ("--window-size=600,400", "--virtual-time-budget=3000")
    options += (f"--screenshot={shot}", f"--user-data-dir={tmp_path / 'profile'}")
    address = f"file://{tmp_path / 'page.html'}#0.5"
    subprocess.run([CHROMIUM, *options, address], capture_output=True, timeout=120)
    picture = images.read_image(shot)[0][:30, :40] / 255
    assert psnr(picture, drawn(0, time)) > 50  # 8 bits alone leave 59
    other = drawn(0, 1.0 - time)
    assert psnr(picture, other) < 30


def test_what_moves_does_not_hide_what_stands_behind_it():
    """The thing behind keeps a colour of its own, though no view shows it."""
    capture = scenes.tiny_capture()
    camera = jax.tree.map(lambda leaf: leaf[capture.train[0]], capture.cameras)
    ahead = camera.position + np.outer([0.4, 0.8], camera.camera_from_world[2])
    mean = np.concatenate([np.repeat(ahead[:1], 9, axis=0), ahead[1:]])
    rows = splats.from_points(mean, np.full((10, 3), 0.25), degree=0)
    moves = np.arange(10) < 9
    scale = np.where(moves, 1.0, 0.02)  # sheets that fill every picture
    opacity = put(np.where(moves, 0.95, 0.9), "float32")

    def at(time):
        shifted = rows.mean + np.where(moves, 0.1 * time, 0)[:, None] * [1, 0, 0]
        scales = put(np.repeat(scale[:, None], 3, 1), "float32")
        return Gaussians(put(shifted, "float32"), rows.quaternion, scales, opacity)

    seen = sampled.seen_in_training(at, rows, SPEC.raster, jnp.asarray(0), capture)
    assert seen.most[9] > sampled.LEAST_SEEN_PX
    np.testing.assert_allclose(seen.colour[9], 0.25, atol=1e-5)
