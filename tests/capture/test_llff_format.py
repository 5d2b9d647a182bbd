"""LLFF folders against the COLMAP model of the same cameras; broken ones refused."""

import dataclasses
import shutil

import numpy as np
import pytest

from nerfies_jax import capture as room
from nerfies_jax.capture import images, llff_format, nerfies_format
from tests.capture import test_colmap as models
from tests.capture.broken import edited, refused

BOUNDS = (4.0, 9.0)
COUNT = 9


def table(size=models.SIZE):
    """Rows of 3x5 matrices, columns down, right, back, position, (h, w, f), bounds."""
    rows = []
    for row in range(COUNT):
        right, down, ahead = models.rotation(row).as_matrix()
        shape = np.array([size[1], size[0], 30.0 * size[0] / models.SIZE[0]])
        pose = np.stack([down, right, -ahead, models.position(row), shape], axis=1)
        rows.append([*pose.ravel(), *BOUNDS])
    return np.array(rows)


def make(folder, poses=None, folders=("images",), count=COUNT):
    folder.mkdir(exist_ok=True)
    np.save(folder / "poses_bounds.npy", table() if poses is None else poses)
    for name in folders:
        (folder / name).mkdir()
        for row in range(count):
            image = models.image(row)
            if name == "images_2":
                image = image[::2, ::2]
            images.write_png(folder / name / f"f_{row:03d}.png", image)
    return folder


def world(capture):
    return capture.cameras.position / capture.scale + capture.center


def test_the_cameras_are_those_of_the_colmap_model(tmp_path):
    capture = room.load(make(tmp_path / "llff"))
    lens = "PINHOLE 24 16 30 30 12 8"
    known = room.load(models.make(tmp_path / "colmap", lens=lens))
    assert capture.source == "llff"
    assert capture.ids == known.ids
    np.testing.assert_array_equal(capture.images, known.images)
    np.testing.assert_allclose(world(capture), world(known), atol=1e-5)
    for name in ("camera_from_world", "focal_px", "principal_point_px", "pixel_aspect"):
        one, other = (getattr(each.cameras, name) for each in (capture, known))
        np.testing.assert_allclose(one, other, atol=1e-6, err_msg=name)
    np.testing.assert_array_equal(capture.times, known.times)
    assert capture.heldout.tolist() == [4]
    near, far = capture.near / capture.scale, capture.far / capture.scale
    np.testing.assert_allclose([near, far], [0.5 * 4, 1.2 * 9], rtol=1e-5)


def test_a_stored_reduction_is_read_with_its_own_pixels(tmp_path):
    whole = room.load(make(tmp_path / "llff", folders=("images", "images_2")))
    half = room.load(tmp_path / "llff", factor=2)
    assert (whole.size, half.size) == (models.SIZE, (12, 8))
    np.testing.assert_array_equal(half.images[3], models.image(3)[::2, ::2])
    np.testing.assert_allclose(half.cameras.focal_px, 15)
    np.testing.assert_allclose(half.cameras.principal_point_px[0], [6, 4])


def changed(row, column, value):
    poses = table()
    poses[row, column] = value
    return poses


BROKEN = {
    "a NaN": ({"poses": changed(3, 2, np.nan)}, "row 3 is not finite"),
    "no bounds": ({"poses": table()[:, :15]}, "shape (9, 15)"),
    "bounds turned": ({"poses": changed(5, 15, 20.0)}, "row 5 has bounds [20.0, 9.0]"),
    "two sizes": ({"poses": changed(1, 4, 99.0)}, "several sizes"),
    "another size": ({"poses": table((100, 40))}, "24x16 pixels"),
    "an image missing": ({"count": 8}, "8 images for 9 poses"),
    "no images": ({"folders": ()}, "but no images; put them"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_folder_is_refused(tmp_path, case):
    options, words = BROKEN[case]
    refused(llff_format.read, make(tmp_path / "llff", **options), words)


def test_a_nerfies_directory_takes_the_points_of_the_model_beside_it(tmp_path):
    known = room.load(models.make(tmp_path / "model"))
    nerfies_format.write(dataclasses.replace(known, points=None), tmp_path / "out")
    assert room.load(tmp_path / "out").points is None
    beside = tmp_path / "out/colmap/sparse/0"
    shutil.copytree(tmp_path / "model/sparse/0", beside)
    capture = room.load(tmp_path / "out")
    np.testing.assert_allclose(
        capture.points.position, known.points.position, atol=1e-6
    )
    np.testing.assert_array_equal(capture.points.color, known.points.color)
    with edited(tmp_path / "out/camera/f_000.json") as one:
        one["position"][0] += 0.1
    capture = room.load(tmp_path / "out")
    assert capture.points is None
    assert any("has other cameras" in note for note in capture.notes)
