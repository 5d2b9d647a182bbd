"""Cameras from images of a textured room, in a process of their own."""

import dataclasses

import numpy as np
import PIL.Image
import pytest
import scipy.ndimage

from nerfies_jax import capture as room
from nerfies_jax.capture import structure_from_motion as mapping
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.geometry import camera
from nerfies_jax.runtime import events

SIZE = (240, 180)
FOCAL = 220.0


def render(one, textures):
    """Two textured planes, z = 4 behind and z = 3 for x > 0, by intersecting rays."""
    width, height = SIZE
    y, x = np.mgrid[:height, :width] + 0.5
    focal = float(one.focal_px)
    inner = np.stack([(x - width / 2) / focal, (y - height / 2) / focal, x * 0 + 1], -1)
    ray = inner @ one.camera_from_world.astype(float)
    image = None
    for depth, texture in zip((4.0, 3.0), textures, strict=True):
        reach = (depth - one.position[2]) / ray[..., 2]
        hit = one.position + reach[..., None] * ray
        place = np.stack([hit[..., 1] * 90 + 400, hit[..., 0] * 90 + 400])
        seen = scipy.ndimage.map_coordinates(texture, place, order=1, mode="mirror")
        front = hit[..., 0] > 0
        image = seen if image is None else np.where(front, seen, image)
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, -1)


def walk(count):
    """Cameras on a path of 1.8 units, 3 to 4 units from the planes."""
    return [
        ((0.9 * np.sin(0.5 * row), -0.4 * np.cos(0.7 * row), 0.1 * row), 0.0, FOCAL)
        for row in range(count)
    ]


def photograph(folder, count, plain=False, views=walk):
    """Write images, and return their cameras."""
    rng = np.random.default_rng(0)
    textures = [
        np.full((800, 800), 128.0)
        if plain
        else 128
        + 60 * scipy.ndimage.zoom(rng.normal(size=(200, 200)), 4, order=1).clip(-2, 2)
        for _ in range(2)
    ]
    folder.mkdir(parents=True)
    cameras = []
    for row, (place, turn, focal) in enumerate(views(count)):
        target = [0.1 + 3.5 * np.tan(turn), 0, 3.5]
        one = camera.look_at(place, target, [0, -1, 0], focal, SIZE)
        cameras.append(one)
        PIL.Image.fromarray(render(one, textures)).save(folder / f"f{row:02d}.png")
    return cameras


def aligned(guess, true):
    """Error of camera centers after the best similarity, relative to their spread."""
    guess, true = guess - guess.mean(0), true - true.mean(0)
    u, values, v = np.linalg.svd(true.T @ guess)
    scale = values.sum() / (guess**2).sum()
    return np.linalg.norm(true - scale * guess @ (u @ v).T, axis=1).max() / np.ptp(true)


@pytest.mark.slow
def test_cameras_of_a_textured_room_are_found(tmp_path, monkeypatch):
    cameras = photograph(tmp_path / "images", 8)
    masks = tmp_path / "masks"
    masks.mkdir()
    for row in range(8):
        mask = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
        mask[:20] = 0
        PIL.Image.fromarray(mask).save(masks / f"f{row:02d}.png.png")
    spec = mapping.MappingSpec(
        camera_model="SIMPLE_PINHOLE", first_octave=-1, threads=2
    )
    monkeypatch.chdir(tmp_path)  # the child runs elsewhere
    received = []
    with events.subscribe(received.append):
        poses = mapping.run_sfm("images", "out", "masks", spec, features="features.db")
    capture = room.load(poses.folder)
    assert len(capture.ids) == 8
    true = np.array([one.position for one in cameras], float)
    assert aligned(capture.cameras.position.astype(float), true) < 0.02
    np.testing.assert_allclose(capture.cameras.focal_px, FOCAL, rtol=0.05)
    assert capture.moving[:, :20].all()
    assert not capture.moving[:, 20:].any()
    files = sorted(path.name for path in poses.folder.iterdir())
    assert files == ["images", "masks", "sparse"]
    assert (poses.images, poses.placed) == (8, 8)
    assert 0 < poses.error_px < 1
    # The farthest two of eight cameras, 1.8 apart, look at 3 to 4 units away.
    assert 5 < poses.angle_deg < 40
    assert len(poses.lines()) == 1
    ended = [one for one in received if one.get("status") == "done"]
    # The features are kept, and the result does not depend on the number of threads.
    later = []
    with events.subscribe(later.append):
        again = mapping.run_sfm(
            "images",
            "again",
            "masks",
            dataclasses.replace(spec, threads=1),
            features="features.db",
        )
    assert "extracting features" not in {one.get("name") for one in later}
    model = "sparse/0/images.bin"
    assert (again.folder / model).read_bytes() == (poses.folder / model).read_bytes()
    names = [one["name"] for one in ended]
    inner = ["extracting features", "matching features", "placing cameras"]
    assert names == [*inner, "structure from motion"]
    assert ended[0]["done"] == ended[0]["total"] == 8


def zoom(count):
    """The walk, with a focal length that grows by half and shrinks again."""
    return [
        (place, turn, FOCAL * 1.5 ** np.sin(np.pi * row / (count - 1)) ** 2)
        for row, (place, turn, _) in enumerate(walk(count))
    ]


def pan(count):
    """A camera that turns by 34 degrees to either side and moves by 0.3 units."""
    time = np.linspace(0, 1, count)
    return [
        ((0.15 * np.sin(7 * t), 0.1 * np.cos(5 * t), 0.1 * t), 1.2 * t - 0.6, FOCAL)
        for t in time
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("views", "count", "error"),
    [
        (zoom, 12, 0.005),  # 0.27 with a common focal length
        (pan, 16, 0.01),  # the largest, 0.006 measured, of a path as short as this
    ],
)
def test_cameras_that_zoom_or_turn_are_found(views, count, error, tmp_path):
    cameras = photograph(tmp_path / "images", count, views=views)
    spec = mapping.MappingSpec(threads=2, features=1500)
    poses = mapping.run_sfm(tmp_path / "images", tmp_path / "out", spec=spec)
    assert poses.placed == count
    capture = room.load(poses.folder)
    true = np.array([one.position for one in cameras], float)
    assert aligned(capture.cameras.position.astype(float), true) < error
    focal = np.array([float(one.focal_px) for one in cameras])
    np.testing.assert_allclose(capture.cameras.focal_px, focal, rtol=0.01)
    chosen = "a focal length for each image" in " ".join(poses.lines())
    assert chosen == (views is zoom)


@pytest.mark.slow
def test_images_without_texture_are_refused_and_leave_nothing(tmp_path):
    photograph(tmp_path / "images", 3, plain=True)
    with pytest.raises(CaptureError, match="only 0 of 3 images"):
        mapping.run_sfm(tmp_path / "images", tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["images"]


def test_what_cannot_work_is_said_before_it_starts(tmp_path):
    lost = [mapping.CameraGroup(("f00.png", "f01.png"), 1.0)]
    with pytest.raises(CaptureError, match="no such folder"):
        mapping.run_sfm(tmp_path / "images", tmp_path / "out")
    photograph(tmp_path / "images", 2)
    with pytest.raises(CaptureError, match="2 images"):
        mapping.run_sfm(tmp_path / "images", tmp_path / "out")
    photograph(tmp_path / "more", 3)
    with pytest.raises(ValueError, match="each image of the folder once"):
        mapping.run_sfm(tmp_path / "more", tmp_path / "out", groups=lost)
    (tmp_path / "masks").mkdir()
    with pytest.raises(CaptureError, match=r"no mask f00\.png\.png"):
        mapping.run_sfm(tmp_path / "more", tmp_path / "out", tmp_path / "masks")


def test_doubtful_cameras_say_what_to_do():
    good = mapping.Poses(None, 100, 95, 3000, 0.5, 6.0)
    assert len(good.lines()) == 1
    _, *doubts = good._replace(placed=60, error_px=2.5, angle_deg=0.4).lines()
    for doubt, words in zip(
        doubts, ("2.50 px", "0.4 degrees", "40 image"), strict=True
    ):
        assert words in doubt
    assert "200 frames" in doubts[2]
    _, doubt = good._replace(angle_deg=1.7).lines()  # of a camera that mostly turns
    assert "walk while recording" in doubt


def test_a_child_that_dies_is_an_error_not_our_end(tmp_path, monkeypatch):
    photograph(tmp_path / "images", 3)
    monkeypatch.setattr(mapping.sys, "executable", "/bin/false")
    with pytest.raises(CaptureError, match="ended with code 1"):
        mapping.run_sfm(tmp_path / "images", tmp_path / "out")
    slow = tmp_path / "slow"
    slow.write_text("#!/bin/sh\nexec sleep 60\n")
    slow.chmod(0o755)
    monkeypatch.setattr(mapping.sys, "executable", str(slow))
    spec = mapping.MappingSpec(seconds=0.2)
    with pytest.raises(CaptureError, match=r"no cameras after 0\.2 s"):
        mapping.run_sfm(tmp_path / "images", tmp_path / "out", spec=spec)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["images", "slow"]
