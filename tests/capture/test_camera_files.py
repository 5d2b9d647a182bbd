"""Captures written in the layouts of other programs, and read back from those."""

import dataclasses
import json

import numpy as np
import pytest

from nerfies_jax.capture import (
    blender_format,
    colmap,
    colmap_writer,
    transforms_writer,
)
from nerfies_jax.capture.capture import Capture, CaptureError, PointCloud
from nerfies_jax.geometry import camera
from nerfies_jax.geometry.camera import Camera

SIZE = (24, 16)
CENTER, SCALE = (100.0, -20.0, 3.0), 0.25


def hand_made(bent=True, frames=9):
    """A capture whose every number matters, off the origin of its world."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(frames, 3)) * 0.1 + [0.0, 0.0, -2.0]
    cameras = camera.stack(
        [camera.look_at(place, (0, 0, 0), (0, 1, 0), 30.0, SIZE) for place in places]
    )
    lens = {
        "principal_point_px": np.float32(SIZE) / 2 + rng.normal(size=(frames, 2)),
        "pixel_aspect": rng.uniform(0.9, 1.1, frames),
        "radial": bool(bent) * rng.normal(scale=1e-3, size=(frames, 3)),
        "tangential": bool(bent) * rng.normal(scale=1e-3, size=(frames, 2)),
    }
    lens = {name: value.astype(np.float32) for name, value in lens.items()}
    images = frames, SIZE[1], SIZE[0]
    valid = np.ones(images, bool)
    valid[:, :2] = False
    if bent == "fisheye":
        lens["fisheye"] = rng.normal(scale=1e-2, size=(frames, 4)).astype(np.float32)
        lens |= {"radial": np.zeros_like(lens["radial"])}
        lens |= {"tangential": np.zeros_like(lens["tangential"])}
    ids = np.arange(frames, dtype=np.int32)
    return Capture(
        name="hand-made",
        source="test",
        ids=tuple(f"f_{row:03d}" for row in range(frames)),
        images=rng.integers(40, 256, (*images, 3), np.uint8),
        cameras=cameras._replace(**lens),
        times=np.linspace(0, 1, frames, dtype=np.float32) ** 2,
        train=ids[ids % 4 != 1],
        heldout=ids[ids % 4 == 1],
        near=1.0,
        far=3.0,
        warp_ids=ids,
        appearance_ids=ids,
        camera_ids=0 * ids,
        valid=valid,
        points=PointCloud(
            rng.uniform(-0.5, 0.5, (60, 3)).astype(np.float32),
            rng.integers(0, 256, (60, 3), np.uint8),
        ),
        scale=SCALE,
        center=CENTER,
        up=(0.0, -1.0, 0.0),
        frames_per_second=12.0,
    )


def in_world(capture):
    """Cameras and points of a capture as its own files would have them."""
    cameras = capture.cameras
    places = (cameras.position, capture.points.position)
    return [np.float64(p) / capture.scale + np.array(capture.center) for p in places]


def same_cameras(read, written, rows):
    """All that does not depend on where a reader puts the scene."""
    for field in Camera._fields:
        if field != "position" and getattr(written, field) is not None:
            one, other = getattr(read, field), getattr(written, field)[rows]
            np.testing.assert_allclose(one, other, rtol=2e-6, atol=2e-7, err_msg=field)


@pytest.mark.parametrize("units", ["scene", "world"])
def test_transforms_come_back_with_times_splits_masks_and_points(units, tmp_path):
    capture = hand_made("fisheye" if units == "world" else True)
    transforms_writer.write(capture, tmp_path / "out", units)
    read = blender_format.read(tmp_path / "out")
    rows = np.concatenate([capture.train, capture.heldout])
    names = [f"images_{capture.ids[row]}" for row in rows]
    assert [*read.ids] == names
    assert len(read.train) == len(capture.train)
    np.testing.assert_array_equal(read.times, capture.times[rows])
    np.testing.assert_array_equal(read.images, capture.images[rows])
    np.testing.assert_array_equal(read.valid, capture.valid[rows])
    np.testing.assert_allclose(read.up, capture.up)
    assert read.frames_per_second == capture.frames_per_second == 12
    same_cameras(read.cameras, capture.cameras, rows)
    if units == "world":
        places = in_world(capture)
    else:
        places = capture.cameras.position, capture.points.position
    for back, exact in zip(in_world(read), (places[0][rows], places[1]), strict=True):
        np.testing.assert_allclose(back, exact, atol=3e-5)
    # As nerfstudio takes it: up and back are the second and third axis of the camera.
    table = json.loads((tmp_path / "out" / "transforms.json").read_text())
    pose = np.array(table["frames"][1]["transform_matrix"])
    right, down, forward = capture.cameras.camera_from_world[1]
    np.testing.assert_allclose(pose[:3, :3], np.stack([right, -down, -forward], 1))


@pytest.mark.parametrize("bent", [True, False, "fisheye"])
def test_transforms_have_what_the_parser_of_nerfstudio_requires(bent, tmp_path):
    """Its rules as of 1.1, `nerfstudio/data/dataparsers/nerfstudio_dataparser.py`."""
    capture = hand_made(bent)
    transforms_writer.write(capture, tmp_path / "out")
    meta = json.loads((tmp_path / "out/transforms.json").read_text())
    model = {True: "OPENCV", False: "PINHOLE", "fisheye": "OPENCV_FISHEYE"}[bent]
    assert meta["camera_model"] == model
    names = [frame["file_path"] for frame in meta["frames"]]
    for frame in meta["frames"]:
        # Each of these is in the file or in every frame.
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            assert key in meta or isinstance(frame[key], float)
        assert np.shape(frame["transform_matrix"]) == (4, 4)
        for key in ("file_path", "mask_path"):  # masks for all frames or for none
            assert (tmp_path / "out" / frame[key]).is_file()
    # If there is a list of any split, there must be one of each, of known names.
    for split in ("train", "val", "test"):
        assert set(meta[f"{split}_filenames"]) <= set(names)
    assert (tmp_path / "out" / meta["ply_file_path"]).is_file()


@pytest.mark.parametrize("bent", [True, False, "fisheye"])
def test_a_colmap_model_comes_back_through_colmap(bent, tmp_path):
    capture = hand_made(bent, frames=20)
    moving = np.zeros(capture.images.shape[:3], bool)
    moving[:, 5:9, 5:9] = True
    capture = dataclasses.replace(capture, moving=moving)
    colmap_writer.write(capture, tmp_path / "out", "world")
    read = colmap.read(tmp_path / "out")
    assert read.ids == capture.ids
    np.testing.assert_array_equal(read.images, capture.images)
    np.testing.assert_array_equal(read.valid, capture.valid)
    np.testing.assert_array_equal(read.moving, moving)
    same_cameras(read.cameras, capture.cameras, slice(None))
    positions, points = in_world(capture)
    np.testing.assert_allclose(in_world(read)[0], positions, atol=3e-5)
    model = colmap.read_model(tmp_path / "out" / "sparse" / "0")
    shown = np.abs(model.points[:, None] - points).max(axis=2).argmin(axis=1)
    np.testing.assert_allclose(model.points, points[shown], atol=1e-9)
    np.testing.assert_array_equal(model.colors, capture.points.color[shown])
    assert len(shown) > 20
    # Depths are in the same units, of the frames that show each point.
    assert len(model.depths) <= colmap_writer.MOST_SEEN * len(points)
    assert capture.near / SCALE < np.median(model.depths) < capture.far / SCALE


def test_the_pixels_of_a_colmap_model_are_where_its_points_are_seen(tmp_path):
    """By hand, from the text: every pixel is the projection of the point it names."""
    capture = hand_made(False)
    colmap_writer.write(capture, tmp_path / "out")
    model = tmp_path / "out" / "sparse" / "0"
    rows = {
        name: [line.split() for line in (model / name).read_text().splitlines()]
        for name in ("points3D.txt", "images.txt", "cameras.txt")
    }
    points = {int(n): np.float64([x, y, z]) for n, x, y, z, *_ in rows["points3D.txt"]}
    lens = {int(n): np.float64(rest) for n, _, _, _, *rest in rows["cameras.txt"]}
    seen = 0
    for pose, places in zip(*(rows["images.txt"][n::2] for n in (0, 1)), strict=True):
        _, w, *vector, tx, ty, tz, number, _ = pose
        w, (x, y, z) = float(w), map(float, vector)
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        fx, fy, cx, cy = lens[int(number)]
        for u, v, point in np.reshape(places, (-1, 3)):
            a, b, depth = turn @ points[int(point)] + np.float64([tx, ty, tz])
            where = fx * a / depth + cx, fy * b / depth + cy
            np.testing.assert_allclose(where, np.float64([u, v]), atol=2e-3)
            seen += 1
    assert seen > 100


def renamed(capture, name):
    return dataclasses.replace(capture, ids=(name, *capture.ids[1:]))


def skewed(capture):
    skew = capture.cameras.skew_px + 1
    return dataclasses.replace(capture, cameras=capture.cameras._replace(skew_px=skew))


@pytest.mark.parametrize(
    ("change", "module", "words"),
    [
        (skewed, transforms_writer, "a skew of 1 px"),
        (skewed, colmap_writer, "a skew of 1 px"),
        (lambda c: renamed(c, "a/b"), transforms_writer, "without slashes"),
        (lambda c: renamed(c, "a b"), colmap_writer, "has a space"),
    ],
)
def test_what_a_format_has_no_place_for_is_refused(change, module, words, tmp_path):
    with pytest.raises(CaptureError, match=words):
        module.write(change(hand_made(frames=3)), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
