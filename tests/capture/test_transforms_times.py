"""Times of transforms*.json: of some frames, of none, of one split."""

import numpy as np
import pytest

from nerfies_jax.capture import blender_format
from nerfies_jax.capture.capture import CaptureError
from tests.capture.broken import edited
from tests.capture.test_blender_format import make


def rewrite(root, change, name="transforms.json"):
    with edited(root / name) as table:
        for row, entry in enumerate(table["frames"]):
            change(row, entry)


def times_by_number(capture):
    return {
        int(name.split("_")[-1]): t
        for name, t in zip(capture.ids, capture.times, strict=True)
    }


def test_frames_without_a_time_lie_between_their_neighbors(tmp_path):
    make(tmp_path, {"": 9})

    def forget(row, entry):
        entry["time"] = None if row in (0, 3, 4) else row / 10

    rewrite(tmp_path, forget)
    capture = blender_format.read(tmp_path)
    expected = {row: row / 10 for row in range(9)}
    assert times_by_number(capture) == pytest.approx(expected, abs=1e-6)
    assert [name for row, name in enumerate(capture.ids) if row in capture.heldout] == [
        "images_r_4"
    ]


def test_a_time_that_cannot_be_known_is_refused(tmp_path):
    make(tmp_path, {"": 9})
    late = [row / 7 for row in range(8)] + [None]
    rewrite(tmp_path, lambda row, entry: entry.update(time=late[row]))
    with pytest.raises(CaptureError, match="r_8' has no time, and none can be"):
        blender_format.read(tmp_path)


def test_a_split_without_times_is_spread_evenly(tmp_path):
    make(tmp_path)
    rewrite(tmp_path, lambda _, entry: entry.pop("time"), "transforms_test.json")
    capture = blender_format.read(tmp_path)
    np.testing.assert_allclose(capture.times[-3:], [0, 0.5, 1])
    assert any("transforms_test.json: spaced evenly" in note for note in capture.notes)


def test_times_come_from_names_where_no_frame_has_one(tmp_path):
    make(tmp_path, {"": 4}, times=False)
    names = ["cam1_0.5", "cam1_2", "cam2_0.5", "cam2_2"]

    def rename(row, entry):
        target = tmp_path / f"images/{names[row]}.png"
        (tmp_path / f"images/r_{row}.png").rename(target)
        entry["file_path"] = f"images/{names[row]}.png"

    rewrite(tmp_path, rename)
    capture = blender_format.read(tmp_path)
    assert dict(zip(capture.ids, capture.times.tolist(), strict=True)) == {
        f"images_{name}": float(row % 2) for row, name in enumerate(names)
    }
    assert len(set(capture.camera_ids[capture.times == 0].tolist())) == 2


@pytest.mark.parametrize("lists", [False, True])
def test_frames_without_a_pose_are_refused_or_left_out(lists, tmp_path):
    make(tmp_path, {"": 9})

    def forget(row, entry):
        if row in (2, 7):
            entry["transform_matrix"] = None

    rewrite(tmp_path, forget)
    with edited(tmp_path / "transforms.json") as table:
        del table["frames"][2]["transform_matrix"]
        if lists:
            names = [entry["file_path"] for entry in table["frames"]]
            table |= {"train_filenames": names[:7], "test_filenames": names[7:]}
    with pytest.raises(CaptureError, match=r"2 of 9 frames have no transform_matrix"):
        blender_format.read(tmp_path)
    capture = blender_format.read(tmp_path, missing="skip")
    assert sorted(times_by_number(capture)) == [0, 1, 3, 4, 5, 6, 8]
    assert len(capture.heldout) == 1
    assert "2 frames left out, they have no transform_matrix" in "".join(capture.notes)


def test_notes_say_what_is_held_out(tmp_path):
    make(tmp_path / "empty", {"train": 9, "test": 0})
    capture = blender_format.read(tmp_path / "empty")
    assert len(capture.heldout) == 1
    assert "transforms_test.json has no frames" in capture.notes
    assert "no other split: every 8th frame is held out" not in capture.notes
    make(tmp_path / "two", {"": 2})
    (note, *_) = blender_format.read(tmp_path / "two").notes
    assert note == "no other split: no frames are held out: there are too few"
