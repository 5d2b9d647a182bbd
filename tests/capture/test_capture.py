"""The record of a capture: what it refuses, and how it shrinks and splits."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax.capture import capture as capturing
from nerfies_jax.capture import name_times, splits
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
    images = (frames, height, width)
    rows = np.arange(frames)
    values = dict(
        name="test",
        source="nerfies",
        ids=tuple(f"f{i}" for i in range(frames)),
        images=rng.integers(0, 256, (*images, 3), np.uint8),
        cameras=cameras,
        times=np.linspace(0, 1, frames, dtype=np.float32),
        train=rows[1:],
        heldout=rows[:1],
        near=0.5,
        far=4.0,
        warp_ids=rows.astype(np.int32),
        appearance_ids=rows.astype(np.int32),
        camera_ids=np.zeros(frames, np.int32),
        valid=rng.random(images) < 0.8,
        moving=rng.random(images) < 0.2,
        depths=np.where(rng.random(images) < 0.6, 2, 0).astype(np.float32),
        points=PointCloud(eye.astype(np.float32), np.zeros((frames, 3), np.uint8)),
    )
    return Capture(**(values | changes))


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"far": 1e38}, "far is 1e\\+38"),
        ({"near": 1e-30}, "near is 1e-30"),
        ({"scale": 1e-40}, "scale is 1e-40"),
        ({"depths": np.full((4, 4, 6), 3e38, np.float32)}, "largest depth is 3e\\+38"),
    ],
)
def test_lengths_that_float32_cannot_compute_with_are_refused(changes, what):
    with pytest.raises(CaptureError, match=what):
        make(**changes)


@pytest.mark.parametrize(
    ("count", "every", "expected"),
    [(2, 8, []), (3, 8, [1]), (5, 8, [2]), (60, 1000, [30]), (16, 8, [4, 12])],
)
def test_few_frames_hold_one_out_and_two_none(count, every, expected):
    learned, scored = splits.hold_out_every(count, every, "here")
    assert scored.tolist() == expected
    assert sorted([*learned, *scored]) == list(range(count))


def test_names_without_a_common_count_have_an_order_and_a_note():
    assert name_times.clock(["a_07", "a_09"]) == ([7, 9], None, ())
    numbers, _, (note,) = name_times.clock(["right_07", "left_07"])
    assert numbers == [1, 0]
    assert "order" in note


@pytest.mark.parametrize(
    ("names", "times", "cameras"),
    [
        (["t0.0", "t0.05", "t0.1", "t0.25"], [0, 0.05, 0.1, 0.25], None),
        (
            ["1305031102.175304", "1305031102.2"],
            [1305031102.175304, 1305031102.2],
            None,
        ),
        (["1.9", "1.10", "1.1"], [9, 10, 1], None),  # counts: 1.1 and 1.10 differ
        (["f_3_rgb2", "f_12_rgb2"], [3, 12], None),
        (["t0,5", "t0,25"], [0.5, 0.25], None),
        (["f1_0.5", "f2_0.75"], [0.5, 0.75], None),  # each frame has a count as well
        # Timestamps of one clock, of cameras that are not quite synchronized.
        (
            ["a/1000000001", "a/1000000011", "b/1000000002", "b/1000000013"],
            [1000000001, 1000000011, 1000000002, 1000000013],
            [0, 0, 1, 1],
        ),
        (["a/1000000001", "a/1000000002", "b/1000000003"], [0, 1, 2], None),
        (["a/0", "a/1", "b/0", "b/1"], [0, 1, 0, 1], [0, 0, 1, 1]),
        (["a\\0", "a\\1", "b\\0", "b\\1"], [0, 1, 0, 1], [0, 0, 1, 1]),
        (["cam1_0.5", "cam1_1", "cam2_0.5", "cam2_1"], [0.5, 1, 0.5, 1], [0, 0, 1, 1]),
        (["7/cam1", "7/cam2", "9/cam1", "9/cam2"], [7, 7, 9, 9], [0, 1, 0, 1]),
        # Clips that follow each other share few numbers.
        (["a/0", "a/1", "b/1", "b/2", "b/3"], [0, 1, 2, 3, 4], None),
        (
            ["d_20240131_000050", "d_20240131_000100", "d_20240131_000150"],
            [50, 100, 150],
            None,
        ),
    ],
)
def test_names_tell_times_and_cameras(names, times, cameras):
    clock = name_times.clock(names)
    assert clock.times == times
    assert (None if clock.cameras is None else clock.cameras.tolist()) == cameras


@pytest.mark.parametrize(
    ("stems", "gaps"),
    [
        (["IMG_20240101_115959", "IMG_20240101_120000"], [1_000_000]),
        (["PXL_20231231_235959000", "x-20240101000000"], [1_000_000]),  # over midnight
        (["20240229-235959500", "20240301-000000250"], [750_000]),
        (["2024-01-31T23-59-59", "2024-02-01T00-00-00.5"], [1_500_000]),
        (["at 2024-01-31 23:59:59Z", "at 2024-02-01 00:00:01"], [2_000_000]),
        (["20240131_235958_001", "20240131_235958_002"], [1000]),  # a burst
        (["a_20241301_000001", "a_20241301_000061"], [60]),  # no date: a count
    ],
)
def test_phones_name_images_by_date_and_time_of_day(stems, gaps):
    times, _, notes = name_times.clock(stems)
    assert np.diff(times).tolist() == gaps
    assert notes == ()


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


@pytest.mark.parametrize(("size", "factor"), [((7, 5), 2), ((9, 7), 3)])
def test_downscale_averages_each_block(size, factor):
    whole = make(size=size)
    small = capturing.downscale(whole, factor)
    width, height = size[0] // factor, size[1] // factor
    assert small.size == (width, height)
    for frame in range(4):
        for row in range(height):
            for column in range(width):
                rows, columns = (
                    slice(i * factor, (i + 1) * factor) for i in (row, column)
                )
                block = frame, rows, columns
                here = frame, row, column
                mean = whole.images[block].reshape(-1, 3).astype(float).mean(0)
                assert (np.abs(small.images[here] - mean) <= 0.5).all()
                assert small.valid[here] == whole.valid[block].all()
                assert small.moving[here] == whole.moving[block].any()
                depth = whole.depths[block]
                known = depth[depth > 0]
                assert small.depths[here] == (known.mean() if known.size else 0)


def test_describe_says_what_was_found():
    text = "\n".join(capturing.describe(make(notes=("mended a thing",))))
    for words in ("4 frames of 6x4", "3 for training", "1 held out", "mended a thing"):
        assert words in text
    bare = dataclasses.replace(
        make(), valid=None, moving=None, depths=None, points=None
    )
    assert len(capturing.describe(bare)) == 2


def test_depths_of_points_are_those_of_a_loop_over_the_captured_views():
    capture = scenes.tiny_capture()
    expected = []
    for row in capture.train:
        turn = capture.cameras.camera_from_world[row].astype(float)
        for point in capture.points.position:
            depth = (turn @ (point - capture.cameras.position[row]))[2]
            expected.extend([depth] if depth > capture.near else [])
    depths = capturing.point_depths(capture)
    np.testing.assert_allclose(np.sort(depths), np.sort(expected), rtol=1e-5)
    without = dataclasses.replace(capture, points=None)
    assert capturing.point_depths(without).size == 0
