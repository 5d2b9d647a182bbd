"""Synchronized cameras of Neural 3D Video: videos, folders of images, and refusals."""

import functools

import numpy as np
import pytest

from nerfies_jax import capture as room
from nerfies_jax.capture import formats, images, rig_format, video
from tests.capture import test_colmap as models
from tests.capture import test_llff_format as llff
from tests.capture.broken import refused

CAMERAS, COUNT = 3, 4


def gray(camera, number):
    """An image whose brightness tells the camera and the frame."""
    value = np.uint8(40 + 60 * camera + 12 * number)
    return np.full((*models.SIZE[::-1], 3), value)


def make(root, kind="videos", counts=(COUNT,) * CAMERAS, rates=(10,) * CAMERAS):
    root.mkdir(exist_ok=True)
    np.save(root / "poses_bounds.npy", llff.table()[:CAMERAS])
    for row, count in enumerate(counts):
        shown = [gray(row, number) for number in range(count)]
        if kind == "videos":
            video.write_video(root / f"cam{row:02d}.mp4", shown, rates[row], quality=1)
            continue
        folder = root / kind.format(row)
        folder.mkdir(parents=True)
        for number, image in enumerate(shown):
            images.write_png(folder / f"{number:04d}.png", image)
    return root


@pytest.mark.parametrize(
    "kind", ["videos", "cam{:02d}", "images/cam{:02d}", "{:02d}/images"]
)
def test_each_camera_has_one_pose_and_frames_of_equal_times(kind, tmp_path):
    capture = room.load(make(tmp_path / "rig", kind))
    assert capture.source == "rig"
    assert capture.camera_ids.tolist() == np.repeat(range(CAMERAS), COUNT).tolist()
    np.testing.assert_allclose(capture.times, np.tile(np.linspace(0, 1, 4), 3), 1e-6)
    assert capture.warp_ids.tolist() == [*range(COUNT)] * CAMERAS
    shown = [gray(row, number) for row in range(CAMERAS) for number in range(COUNT)]
    np.testing.assert_allclose(capture.images, shown, atol=3)  # of video compression
    world = capture.cameras.position / capture.scale + capture.center
    for row, camera in enumerate(capture.camera_ids):
        np.testing.assert_allclose(world[row], models.position(camera), atol=1e-5)
    assert capture.heldout.tolist() == [*range(COUNT)]
    assert "held out, 2 cameras are for training" in capture.notes[-1]
    assert capture.frames_per_second in (None, pytest.approx(10))


def test_a_camera_or_every_nth_frame_is_held_out(tmp_path):
    root = make(tmp_path / "rig", "cam{:02d}")
    assert rig_format.read(root, heldout="cam01").heldout.tolist() == [4, 5, 6, 7]
    assert len(rig_format.read(root, heldout=4).heldout) == CAMERAS
    other = functools.partial(rig_format.read, heldout="cam7")
    refused(other, root, "there are cam00, cam01, cam02")
    half = rig_format.read(root, factor=2)
    assert half.size == (12, 8)
    np.testing.assert_allclose(half.cameras.focal_px, 15)


def test_cameras_of_other_rates_and_lengths_keep_their_times(tmp_path):
    counts, rates = (6, 3, 6), (20, 10, 20)
    capture = room.load(make(tmp_path / "rig", counts=counts, rates=rates))
    assert capture.warp_ids.tolist() == [*range(6), 0, 2, 4, *range(6)]
    assert "cam01.mp4 has 3, cam00.mp4 has 6" in " ".join(capture.notes)


def test_what_does_not_fit_the_poses_is_refused(tmp_path):
    root = make(tmp_path / "rig", "cam{:02d}")
    np.save(root / "poses_bounds.npy", llff.table()[:2])
    refused(rig_format.read, root, "3 folders of images (cam00, ...) for 2 cameras")
    np.save(root / "poses_bounds.npy", llff.table((100, 40))[:CAMERAS])
    refused(rig_format.read, root, "24x16 pixels, but poses_bounds.npy is for 100x40")
    (root / "poses_bounds.npy").unlink()
    for row in range(2):
        (root / f"cam{row}.mp4").touch()
    refused(formats.recognize, root, "2 videos (cam0.mp4, ...) without cameras")
