"""The record of a capture: what it refuses, and how it shrinks and splits."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nerfies_jax.capture
from nerfies_jax.capture import capture as capturing
from nerfies_jax.capture.capture import Capture, CaptureError, PointCloud
from nerfies_jax.geometry import camera
from tests import scenes


def make(frames=4, size=(6, 4), **changes):
    rng = np.random.default_rng(0)
    width, height = size
    eye = rng.normal(size=(frames, 3))
    cameras = camera.stack(
        [camera.look_at(e, e * 0 + 3, [0, 0, 1], 7.0, size) for e in eye]
    )
    cameras = cameras._replace(skew_px=np.full(frames, 0.5, np.float32))
    pictures = (frames, height, width)
    rows = np.arange(frames)
    values = dict(
        name="test",
        source="nerfies",
        ids=tuple(f"f{i}" for i in range(frames)),
        images=rng.integers(0, 256, (*pictures, 3), np.uint8),
        cameras=cameras,
        times=np.linspace(0, 1, frames, dtype=np.float32),
        train=rows[1:],
        heldout=rows[:1],
        near=0.5,
        far=4.0,
        warp_ids=rows.astype(np.int32),
        appearance_ids=rows.astype(np.int32),
        camera_ids=np.zeros(frames, np.int32),
        valid=rng.random(pictures) < 0.8,
        moving=rng.random(pictures) < 0.2,
        depths=np.where(rng.random(pictures) < 0.6, 2, 0).astype(np.float32),
        points=PointCloud(eye.astype(np.float32), np.zeros((frames, 3), np.uint8)),
    )
    return Capture(**(values | changes))


def one_camera(capture, row):
    return jax.tree.map(jnp.asarray, camera.take(capture.cameras, row))


def broken_camera(field, value):
    cameras = make().cameras
    leaf = getattr(cameras, field).copy()
    leaf[2] = value
    return {"cameras": cameras._replace(**{field: leaf})}


def nan_depth():
    depths = make().depths.copy()
    depths[1, 0, 0] = np.nan
    return {"depths": depths}


BAD = {
    "doubled id": (dict(ids=("a", "b", "b", "c")), "'b' appears 2 times"),
    "float images": (dict(images=np.zeros((4, 4, 6, 3))), "float64"),
    "missing image": (dict(images=np.zeros((3, 4, 6, 3), np.uint8)), "4 ids"),
    "no pixels": (dict(images=np.zeros((4, 0, 6, 3), np.uint8)), "(4, 0, 6, 3)"),
    "mask of another size": (dict(valid=np.ones((4, 6, 4), bool)), "(4, 6, 4)"),
    "mask as bytes": (dict(moving=np.ones((4, 4, 6), np.uint8)), "uint8"),
    "times short": (dict(times=np.zeros(3, np.float32)), "(3,)"),
    "time above 1": (dict(times=np.float32([0, 0.5, 1, 1.5])), "'f3' has time 1.5"),
    "time NaN": (dict(times=np.float32([0, np.nan, 1, 1])), "'f1' has time nan"),
    "near beyond far": (dict(near=5.0), "near = 5"),
    "near zero": (dict(near=0.0), "near = 0"),
    "far infinite": (dict(far=np.inf), "far = inf"),
    "scale zero": (dict(scale=0.0), "scale = 0"),
    "centre NaN": (dict(centre=(0.0, np.nan, 0.0)), "nan"),
    "id negative": (dict(warp_ids=np.int32([0, 1, 2, -1])), "'f3' has warp_id -1"),
    "id huge": (dict(camera_ids=np.int32([0, 2**30, 0, 0])), "camera_id 1073741824"),
    "row outside": (dict(train=np.array([1, 4])), "row 4"),
    "row negative": (dict(heldout=np.array([-1])), "row -1"),
    "row twice": (dict(train=np.array([1, 1])), "twice"),
    "rows as floats": (dict(train=np.array([1.0])), "row numbers"),
    "train empty": (dict(train=np.array([], int)), "no frame to learn from"),
    "train meets heldout": (dict(heldout=np.array([2])), "'f2' is both"),
    "points infinite": (
        dict(points=PointCloud(np.full((2, 3), np.inf), np.zeros((2, 3), np.uint8))),
        "2 scene points",
    ),
    "points without colour": (
        dict(points=PointCloud(np.zeros((2, 3)), np.zeros((1, 3), np.uint8))),
        "(1, 3)",
    ),
    "depth NaN": (nan_depth(), "'f1' has 1"),
    "camera NaN": (broken_camera("position", np.nan), "camera 'f2': position"),
    "camera infinite": (broken_camera("radial", np.inf), "camera 'f2': radial"),
    "camera focal": (broken_camera("focal_px", -3), "camera 'f2': focal_px"),
    "camera mirrored": (
        broken_camera("camera_from_world", np.diag([1, 1, -1])),
        "camera 'f2': orientation is a reflection",
    ),
    "camera scaled": (
        broken_camera("camera_from_world", 2 * np.eye(3)),
        "camera 'f2': orientation is not orthonormal",
    ),
    "cameras short": (
        dict(cameras=camera.take(make().cameras, np.arange(3))),
        "one per frame",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_capture_that_cannot_be_right_is_refused_in_one_line(case):
    changes, said = BAD[case]
    with pytest.raises(CaptureError) as caught:
        make(**changes)
    message = str(caught.value)
    assert said in message
    assert message.startswith("test: ")
    assert "\n" not in message


def test_a_single_frame_is_refused():
    with pytest.raises(CaptureError, match="at least 2 views"):
        make(frames=1, train=np.array([0]), heldout=np.array([], int))


def test_select_keeps_what_belongs_to_each_frame():
    whole = make(frames=5, train=np.array([0, 2, 4]), heldout=np.array([1, 3]))
    part = capturing.select(whole, np.array([3, 0, 2]))
    assert part.ids == ("f3", "f0", "f2")
    assert part.train.tolist() == [1, 2]
    assert part.heldout.tolist() == [0]
    for name in ("images", "times", "warp_ids", "valid", "moving", "depths"):
        np.testing.assert_array_equal(
            getattr(part, name), getattr(whole, name)[[3, 0, 2]]
        )
    np.testing.assert_array_equal(part.cameras.position[1], whole.cameras.position[0])


@pytest.mark.parametrize(("size", "factor"), [((6, 4), 2), ((7, 5), 2), ((9, 7), 3)])
def test_downscale_averages_each_block(size, factor):
    whole = make(size=size)
    small = capturing.downscale(whole, factor)
    width, height = size[0] // factor, size[1] // factor
    assert small.size == (width, height)
    for frame in range(4):
        for row in range(height):
            for column in range(width):
                block = (
                    frame,
                    slice(row * factor, (row + 1) * factor),
                    slice(column * factor, (column + 1) * factor),
                )
                here = frame, row, column
                mean = whole.images[block].reshape(-1, 3).astype(float).mean(0)
                assert (np.abs(small.images[here] - mean) <= 0.5).all()
                assert small.valid[here] == whole.valid[block].all()
                assert small.moving[here] == whole.moving[block].any()
                depth = whole.depths[block]
                known = depth[depth > 0]
                assert small.depths[here] == (known.mean() if known.size else 0)


def test_downscale_keeps_every_point_on_its_pixel():
    whole = make(size=(8, 6))
    small = capturing.downscale(whole, 2)
    point = jnp.asarray([2.5, 3.1, 2.8])
    for row in range(4):
        pixel, depth = camera.project(one_camera(whole, row), point)
        half, same = camera.project(one_camera(small, row), point)
        np.testing.assert_allclose(half * 2, pixel, rtol=1e-5)
        assert depth == same


@pytest.mark.parametrize("factor", [0, 5, -1])
def test_downscale_refuses_what_leaves_no_picture(factor):
    with pytest.raises(CaptureError, match=r"test: cannot make 6x4 pictures"):
        capturing.downscale(make(), factor)


def test_describe_says_what_was_found():
    text = "\n".join(capturing.describe(make(notes=("mended a thing",))))
    for said in ("4 frames of 6x4", "3 to learn from", "1 held out", "mended a thing"):
        assert said in text
    bare = dataclasses.replace(
        make(), valid=None, moving=None, depths=None, points=None
    )
    assert len(capturing.describe(bare)) == 2


def test_the_room_offers_load_and_nothing_else_by_accident():
    assert callable(nerfies_jax.capture.load)
    with pytest.raises(AttributeError, match="nonsense"):
        _ = nerfies_jax.capture.nonsense


def test_depths_of_points_are_those_of_a_loop_over_the_filmed_views():
    capture = scenes.tiny_capture()
    expected = []
    for row in capture.train:
        turn = capture.cameras.camera_from_world[row].astype(float)
        for point in capture.points.position:
            depth = (turn @ (point - capture.cameras.position[row]))[2]
            expected.extend([depth] if depth > capture.near else [])
    found = capturing.point_depths(capture)
    np.testing.assert_allclose(np.sort(found), np.sort(expected), rtol=1e-5)
    without = dataclasses.replace(capture, points=None)
    assert capturing.point_depths(without).size == 0
