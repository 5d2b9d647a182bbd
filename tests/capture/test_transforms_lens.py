"""Intrinsics of transforms*.json, of the file and of its frames."""

import math

import numpy as np
import pytest

from nerfies_jax.capture import blender_format
from nerfies_jax.capture.capture import CaptureError
from tests.capture.broken import edited
from tests.capture.test_blender_format import make


def in_frame(top, frame):
    """Cameras of a file with these keys, of which one frame has others."""

    def load(root):
        make(root, {"": 6}, top=top)
        with edited(root / "transforms.json") as table:
            table["frames"][0] |= frame
        capture = blender_format.read(root)
        row = capture.ids.index("images_r_0")
        focal = capture.cameras.focal_px[row]
        aspect = capture.cameras.pixel_aspect[row]
        center = capture.cameras.principal_point_px[row]
        return [focal, focal * aspect, *center], capture.notes

    return load


ANGLES = {"camera_angle_x": 2 * math.atan(5 / 20), "camera_angle_y": 2 * math.atan(0.2)}
LEVELS = {
    "both angles": (ANGLES, {}, [20, 20, 5, 4]),
    "angle down alone": (
        {"camera_angle_y": ANGLES["camera_angle_y"]},
        {},
        [20, 20, 5, 4],
    ),
    "angles of other pixels": (
        ANGLES | {"camera_angle_y": 2 * math.atan(0.16)},
        {},
        [20, 25, 5, 4],
    ),
    "degrees": ({"x_fov": 90.0}, {}, [5, 5, 5, 4]),
    "frame's focal length": (
        {"fl_x": 20.0, "fl_y": 21.0},
        {"fl_x": 30.0},
        [30, 30, 5, 4],
    ),
    "frame's angle": ({"fl_x": 20.0, "fl_y": 21.0}, {"x_fov": 90.0}, [5, 5, 5, 4]),
    "frame's size": (
        {"fl_x": 40.0, "cx": 11.0, "cy": 7.0, "w": 20, "h": 16},
        {"w": 10, "h": 8},
        [20, 20, 5.5, 3.5],
    ),
    "frame's calibration of larger images": (
        {"fl_x": 20.0, "cx": 5.0, "cy": 4.0, "w": 10, "h": 8},
        {"fl_x": 40.0, "cx": 11.0, "cy": 7.0, "w": 20, "h": 16},
        [20, 20, 5.5, 3.5],
    ),
    "larger images": ({"fl_x": 60.0, "cx": 15.3, "cy": 11.7}, {}, [20, 20, 5.1, 3.9]),
    "corner of a larger image": (
        {"fl_x": 60.0, "cx": 10.0, "cy": 8.0, "w": 10, "h": 8},
        {},
        [60, 60, 10, 8],
    ),
}


@pytest.mark.parametrize("case", LEVELS)
def test_intrinsics_are_of_the_frame_or_of_the_file_as_units(case, tmp_path):
    top, frame, expected = LEVELS[case]
    actual, notes = in_frame(top, frame)(tmp_path)
    np.testing.assert_allclose(actual, expected, rtol=1e-5)
    assert any("principal point" in note for note in notes) == (case == "larger images")


LENS_OF_FRAME = {
    "panorama": ({"fl_x": 20.0}, {"camera_model": "EQUIRECTANGULAR"}, "EQUIRECT"),
    "angle too large": (ANGLES, {"camera_angle_y": 4.0}, "camera_angle_y = 4"),
    "other size": ({"fl_x": 20.0, "cx": 8.0, "cy": 6.4}, {}, "1.6 times as large"),
}


@pytest.mark.parametrize("case", LENS_OF_FRAME)
def test_intrinsics_that_cannot_be_are_refused(case, tmp_path):
    top, frame, message = LENS_OF_FRAME[case]
    with pytest.raises(CaptureError, match=message):
        in_frame(top, frame)(tmp_path)


def test_a_matrix_by_columns_is_refused(tmp_path):
    make(tmp_path, {"": 6})
    with edited(tmp_path / "transforms.json") as table:
        for entry in table["frames"]:
            entry["transform_matrix"] = np.transpose(entry["transform_matrix"]).tolist()
    with pytest.raises(CaptureError, match=r"last row .* transpose it"):
        blender_format.read(tmp_path)


def test_the_distortion_of_another_model_is_not_taken_over(tmp_path):
    top = {"fl_x": 20.0, "k1": 0.1, "k4": 0.2, "camera_model": "OPENCV_FISHEYE"}
    make(tmp_path, {"": 6}, top=top, camera_model="PINHOLE")
    assert not blender_format.read(tmp_path).cameras.radial.any()


def test_keys_that_are_not_read_are_named(tmp_path):
    make(tmp_path, {"": 6}, top={"fl_x": 20.0, "aabb_scale": 4}, rolling_shutter=[0, 1])
    notes = blender_format.read(tmp_path).notes
    assert "keys of transforms.json that are not read: rolling_shutter" in notes
