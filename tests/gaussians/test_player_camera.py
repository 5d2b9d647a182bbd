"""The player's camera: its arithmetic in node, and its limits from the capture."""

import numpy as np
import pytest

from gaussians_jax.player.limits import (
    AZIMUTH_MARGIN,
    ELEVATION_MARGIN,
    FARTHEST,
    NEAREST,
    camera_limits,
)
from nerfies_jax.geometry import camera as cameras
from tests.gaussians import browser as shared
from tests.gaussians.browser import by_node, needs_node, program_of

VIEWS = """
const [program, header] = JSON.parse(require("fs").readFileSync(0, "utf8"));
const names = "viewOf, cameraOf, orbited, moved, nearer, toward, apart" +
  ", textOf, viewFrom";
const f = new Function(program + `; return { ${names} }`)();
const broken = ["", "1,2", "0,0,0,0,0,0,0,1", "1,0,0,0,0,0,0,-1", "a,b,c,d,e,f,g,h"];
const lens = header.view, first = f.viewOf(header.view);
const shown = (view) => ({ ...view, ...f.cameraOf(view, lens, 256, 96) });
const link = f.textOf(f.viewFrom(f.textOf(first)));
const far = f.moved(f.orbited(first, header.up, 0.4, -0.3), 0.2, 0.1);
console.log(JSON.stringify({
  first: shown(first),
  orbited: shown(f.orbited(first, header.up, 0.4, -0.3)),
  right: shown(f.orbited(first, header.up, 0.1, 0)),
  moved: shown(f.moved(first, 0.2, 0.1)),
  nearer: shown(f.nearer(first, 0.5)),
  halfway: shown(f.toward(first, far, 0.5)),
  arrived: f.toward(first, far, 1) === far,
  // A quaternion of a link has not quite unit length.
  same: f.apart(far, { ...far, quaternion: far.quaternion.map((x) => -1.0000001 * x) }),
  turned: f.apart(first, f.orbited(first, header.up, 1e-4, 0)),
  links: [f.textOf(first), link],
  broken: broken.map(f.viewFrom),
}));
"""


@needs_node
def test_views_turn_about_their_target():
    header = shared.header()
    answer = by_node(VIEWS, program_of("camera.js"), header)
    view, first = header["view"], answer["first"]
    np.testing.assert_allclose(first["rotation"], view["rotation"], atol=1e-6)
    np.testing.assert_allclose(first["position"], view["position"], atol=1e-6)
    target, start = np.array(view["target"]), np.array(view["position"])
    away = np.linalg.norm(target - start)
    rotations = {}
    for name in ("orbited", "right", "moved", "nearer", "halfway"):
        one = answer[name]
        rotations[name] = rotation = np.reshape(one["rotation"], (3, 3))
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        offset = np.array(one["target"]) - one["position"]
        distance = away * (0.5 if name == "nearer" else 1)
        np.testing.assert_allclose(rotation @ offset, [0, 0, distance], atol=1e-6)
        if name not in ("moved", "halfway"):
            np.testing.assert_allclose(one["target"], target, atol=1e-6)
    rotation = np.reshape(view["rotation"], (3, 3))
    # To the right about up: the height stays, and the camera goes to its right.
    step = np.array(answer["right"]["position"]) - start
    assert step @ header["up"] == pytest.approx(0, abs=1e-6)
    flat = np.linalg.norm(np.cross(start - target, header["up"]))
    assert (rotation @ step)[0] == pytest.approx(np.sin(0.1) * flat, rel=1e-3)
    step = np.array(answer["moved"]["position"]) - start
    np.testing.assert_allclose(rotation @ step, [0.2, 0.1, 0], atol=1e-6)
    angles = [
        np.arccos((np.trace(rotations[name] @ rotation.T) - 1) / 2)
        for name in ("halfway", "orbited")
    ]
    assert angles[0] == pytest.approx(angles[1] / 2, rel=1e-3)
    assert answer["arrived"]
    assert answer["same"] < 1e-9
    assert answer["turned"] == pytest.approx(1e-4, rel=1e-3)
    assert answer["links"][0] == answer["links"][1]
    assert answer["broken"] == [None] * 5
    # An image of 64 x 48 in one of 256 x 96.
    assert (first["enlarged"], first["size"]) == (2, [256, 96])
    assert first["focal"] == pytest.approx(2 * view["focal"])
    place = 2 * (np.array(view["center"]) - (32, 24)) + (128, 48)
    np.testing.assert_allclose(first["center"], place)


def on_sphere(azimuths, elevations, distance=3.0, target=(0.5, -1.0, 2.0)):
    """Cameras around a target, y up; the azimuth is counted from z toward x."""
    poses = []
    for azimuth, elevation in zip(azimuths, elevations, strict=True):
        level = np.cos(elevation)
        away = [np.sin(azimuth) * level, np.sin(elevation), np.cos(azimuth) * level]
        place = np.add(target, np.multiply(distance, away))
        up = (0, 1, 0) if abs(elevation) < 1.5 else (0, 0, -1)
        poses.append(cameras.look_at(place, target, up, 50.0, (64, 48)))
    up = np.array([0.0, 1.0, 0.0])
    return camera_limits(cameras.stack(poses), np.array(target), up, 0.8)


def test_limits_are_those_of_the_capture_with_a_margin():
    # Across +-180 degrees, where angles jump.
    limits = on_sphere([3.0, 2.8, 3.4], [0.1, -0.2, 0.3])
    span = [-0.2 - AZIMUTH_MARGIN, 0.4 + AZIMUTH_MARGIN]
    np.testing.assert_allclose(limits["azimuth"], span, atol=1e-5)
    height = [-0.2 - ELEVATION_MARGIN, 0.3 + ELEVATION_MARGIN]
    np.testing.assert_allclose(limits["elevation"], height, atol=1e-5)
    np.testing.assert_allclose(limits["distance"], [3 * NEAREST, 3 * FARTHEST], 1e-5)
    assert limits["pan"] == pytest.approx(0.8 * 3, rel=1e-5)
    axes = np.array(limits["axes"])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(axes) == pytest.approx(1)


@pytest.mark.parametrize("azimuths", [np.linspace(0, 6, 12), np.linspace(-2.4, 2.4, 9)])
def test_a_capture_from_all_around_has_no_limit_of_the_azimuth(azimuths):
    assert on_sphere(azimuths, 0 * azimuths)["azimuth"] is None


def test_a_first_view_from_straight_above_is_within_its_limits():
    limits = on_sphere([0.0, 0.0], [np.pi / 2, 0.5])
    assert limits["elevation"][1] == pytest.approx(np.pi / 2, abs=1e-3)
    assert np.isfinite(limits["axes"]).all()


LIMITED = """
const [program, header] = JSON.parse(require("fs").readFileSync(0, "utf8"));
const names = "viewOf, orbited, moved, nearer, limited";
const f = new Function(program + `; return { ${names} }`)();
const { limits, up } = header, first = f.viewOf(header.view);
const far = {
  right: f.orbited(first, up, 2, 0), left: f.orbited(first, up, -2, 0),
  above: f.orbited(first, up, 0, 1.3), below: f.orbited(first, up, 0, -1.3),
  near: f.nearer(first, 1e-3), away: f.nearer(first, 1e3),
  aside: f.moved(first, 100, 30),
};
const result = { first: f.limited(first, limits, 0), start: first };
for (const [name, view] of Object.entries(far)) {
  result[name] = [0, 0.1].map((give) => f.limited(view, limits, give));
}
console.log(JSON.stringify(result));
"""


def direction(view):
    """Azimuth and elevation (rad) from the target to the camera; y is up, z ahead."""
    w, x, y, z = np.array(view["quaternion"]) / np.linalg.norm(view["quaternion"])
    forward = [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    away = -np.array(forward)
    return np.arctan2(away[0], away[2]), np.arcsin(away[1])


@needs_node
def test_views_stay_within_the_limits_and_pass_them_a_little_in_a_drag():
    header = shared.header()
    limits = header["limits"]
    answer = by_node(LIMITED, program_of("camera.js"), header)
    assert answer["first"] == answer["start"]
    (low, high), (bottom, top) = limits["azimuth"], limits["elevation"]
    start = direction(answer["start"])
    ends = {
        "right": (high, start[1]),
        "left": (low, start[1]),
        "above": (start[0], top),
        "below": (start[0], bottom),
    }
    for name, expected in ends.items():
        hard, soft = (np.array(direction(view)) for view in answer[name])
        np.testing.assert_allclose(hard, expected, atol=1e-6)
        assert 0.05 < np.abs(soft - hard).max() <= 0.1 + 1e-6
    for name, expected in zip(("near", "away"), limits["distance"], strict=True):
        hard, soft = (view["distance"] for view in answer[name])
        assert hard == pytest.approx(expected)
        assert abs(np.log(soft / hard)) == pytest.approx(0.1, rel=0.01)
    hard, soft = (
        np.linalg.norm(np.subtract(view["target"], limits["target"]))
        for view in answer["aside"]
    )
    assert hard == pytest.approx(limits["pan"])
    assert hard < soft <= 1.1 * limits["pan"] + 1e-9
