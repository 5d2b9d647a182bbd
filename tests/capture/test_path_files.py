"""Camera paths in the files of other programs."""

import json

import jax
import numpy as np
import pytest

from nerfies_jax.capture import keyframes as keyframes_of_paths
from nerfies_jax.capture import path_files, world_points
from nerfies_jax.capture.camera_paths import CameraPath
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.keyframes import Keyframe
from nerfies_jax.geometry import camera
from tests.capture.broken import edited
from tests.capture.test_camera_files import hand_made

SIZE = (64, 36)
TIMES = np.float32([0, 0.25, 1])


def a_path(**lens):
    places = [(0.1, 0.2, -2), (0.3, 0.1, -2.1), (0.2, -0.3, -1.9)]
    cameras = camera.stack(
        [camera.look_at(place, (0, 0, 0), (0, 1, 0), 50.0, SIZE) for place in places]
    )
    return CameraPath(cameras._replace(**lens), SIZE, TIMES)


def test_a_nerfstudio_path_is_drawn_by_nerfstudio_as_by_us(tmp_path):
    """Pixels by the formulas of its renderer: OpenGL axes, a vertical field of view."""
    planned = a_path(pixel_aspect=np.float32([1.1, 1.1, 1.1]))
    path_files.write_nerfstudio(tmp_path / "a.json", planned, 24.0)
    table = json.loads((tmp_path / "a.json").read_text())
    assert (table["render_width"], table["render_height"]) == SIZE
    assert table["seconds"] * table["fps"] == pytest.approx(3)
    point = np.array([0.2, -0.1, 0.3])
    read = path_files.read(tmp_path / "a.json", hand_made(frames=3))
    np.testing.assert_array_equal(read.times, TIMES)
    assert read.size == SIZE
    for row, entry in enumerate(table["camera_path"]):
        assert entry["render_time"] == TIMES[row]
        pose = np.reshape(entry["camera_to_world"], (4, 4))
        x, y, z = pose[:3, :3].T @ (point - pose[:3, 3])
        focal = SIZE[1] / 2 / np.tan(np.radians(entry["fov"]) / 2)
        theirs = focal * np.array([x, -y]) / -z + np.divide(SIZE, 2)
        ours, back = (
            world_points.pixels_of(cameras, row, np.float32(point)[None], SIZE)[0][0]
            for cameras in (planned.cameras, read.cameras)
        )
        # Square pixels are all it has: of ours it keeps the height.
        assert theirs[1] == pytest.approx(ours[1], abs=1e-4)
        np.testing.assert_allclose(back, theirs, atol=1e-4)


def test_a_nerfies_path_keeps_the_whole_camera_and_the_world(tmp_path):
    lens = {
        "principal_point_px": np.float32([[30, 20], [31, 21], [32, 17]]),
        "radial": np.float32([[0.1, 0.01, 0.001]] * 3),
        "skew_px": np.float32([0.5, 0.25, 0]),
    }
    capture, planned = hand_made(frames=3), a_path(**lens)
    path_files.write_nerfies(tmp_path / "path", planned, capture)
    read = path_files.read(tmp_path / "path", capture)
    for field, exact in planned.cameras._asdict().items():
        if exact is None:
            assert getattr(read.cameras, field) is None
            continue
        np.testing.assert_allclose(getattr(read.cameras, field), exact, atol=2e-6)
    np.testing.assert_array_equal(read.times, TIMES)
    assert read.size == SIZE
    entry = json.loads((tmp_path / "path" / "000001.json").read_text())
    place = planned.cameras.position[1] / capture.scale + capture.center
    np.testing.assert_allclose(entry["position"], place, rtol=1e-6)


def test_a_nerfies_path_keeps_a_fisheye_and_refuses_half_of_one(tmp_path):
    lens = np.float32([[0.1, 0.01, 0.001, -0.002]] * 3)
    capture, planned = hand_made(frames=3), a_path(fisheye=lens)
    path_files.write_nerfies(tmp_path / "path", planned, capture)
    read = path_files.read(tmp_path / "path", capture)
    np.testing.assert_allclose(read.cameras.fisheye, lens, rtol=1e-6)
    with edited(tmp_path / "path" / "000001.json") as entry:
        del entry["fisheye_distortion"]
    with pytest.raises(CaptureError, match="1 of 3 cameras have no fisheye"):
        path_files.read(tmp_path / "path", capture)


def test_a_path_without_times_leaves_them_to_whoever_renders_it(tmp_path):
    planned = a_path()._replace(times=None)
    path_files.write_nerfstudio(tmp_path / "a.json", planned, 24.0)
    assert path_files.read(tmp_path / "a.json", hand_made(frames=3)).times is None


def change(table, **first):
    table["camera_path"][0] |= first


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda t: change(t, render_time=1.5), "camera 0 has time 1.5"),
        (lambda t: t["camera_path"][1].pop("render_time"), "1 of 3 cameras have no"),
        (lambda t: change(t, fov=180), "degrees between 0 and 180"),
        (lambda t: change(t, camera_to_world=[1, 0]), "has 2 numbers"),
        (lambda t: change(t, camera_to_world=[2.0] * 16), "not orthonormal"),
        (lambda t: t.update(camera_type="equirectangular"), "only perspective"),
        (lambda t: t.update(camera_path=[]), "no cameras in it"),
        (lambda t: t.update(render_width=1e9), "1000000000x36 pixels"),
        (lambda t: t.pop("camera_path"), "missing required field `camera_path`"),
    ],
)
def test_a_path_that_cannot_be_rendered_is_refused(spoil, words, tmp_path):
    path_files.write_nerfstudio(tmp_path / "a.json", a_path(), 24.0)
    with edited(tmp_path / "a.json") as table:
        spoil(table)
    with pytest.raises(CaptureError, match=words) as caught:
        path_files.read(tmp_path / "a.json", hand_made(frames=3))
    assert str(caught.value).startswith(str(tmp_path / "a.json"))


def test_folders_of_no_cameras_or_of_several_sizes_are_refused(tmp_path):
    capture = hand_made(frames=3)
    with pytest.raises(CaptureError, match="no camera files"):
        path_files.read(tmp_path, capture)
    path_files.write_nerfies(tmp_path / "path", a_path(), capture)
    with edited(tmp_path / "path" / "000002.json") as entry:
        entry["image_size"] = [32, 36]
    with pytest.raises(CaptureError, match="all images of a video have one size"):
        path_files.read(tmp_path / "path", capture)
    with pytest.raises(
        CaptureError, match="nor the name of a camera path; there are s"
    ):
        path_files.named(str(tmp_path / "nowhere"), capture, None)


def test_keyframes_are_read_back_and_come_of_the_cameras_where_there_are_none(tmp_path):
    capture, planned, file = hand_made(frames=3), a_path(), tmp_path / "a.json"
    chosen = [
        Keyframe(camera.take(planned.cameras, row), time)
        for row, time in ((2, 0.75), (0, 0.25))
    ]
    path_files.write_nerfstudio(file, planned, 24.0, keyframes=chosen)
    for read, written in zip(
        path_files.read_keyframes(file, capture), chosen, strict=True
    ):
        assert read.time == pytest.approx(written.time)
        leaves = map(jax.tree.leaves, (read.camera, written.camera))
        for one, other in zip(*leaves, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-5)
    # As nerfstudio's viewer saves them: a pose row by row, and the field of view.
    table = json.loads(file.read_text())
    entry = table["keyframes"][1]
    assert entry["matrix"] == table["camera_path"][0]["camera_to_world"]
    assert entry["fov"] == table["camera_path"][0]["fov"]
    # None, or of an older layout, which cannot be told: the cameras of the path.
    for keyframes in ([], [{"matrix": "[1, 0]", "fov": 50}] * 2):
        file.write_text(json.dumps(table | {"keyframes": keyframes}))
        read = path_files.read_keyframes(file, capture)
        assert [keyframe.time for keyframe in read] == TIMES.tolist()
    # Not hundreds of them, which nobody edits by hand; without times, there and back.
    for each in table["camera_path"]:
        del each["render_time"]
    many = {"camera_path": table["camera_path"] * 50, "keyframes": []}
    file.write_text(json.dumps(table | many))
    read = path_files.read_keyframes(file, capture)
    assert len(read) == keyframes_of_paths.MOST_KEYFRAMES
    times = np.array([keyframe.time for keyframe in read])
    assert times[0] == 0
    assert 0.9 < times.max() <= 1
    assert np.abs(np.diff(times)).max() < 0.1
    file.write_text(json.dumps(table | {"camera_path": []}))
    with pytest.raises(CaptureError, match="no cameras in it"):
        path_files.read_keyframes(file, capture)
