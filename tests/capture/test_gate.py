"""Captures that can be read and cannot be right: units of depth, nothing observed."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax.capture import formats, gate, images, nerfies_format
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.external import ExternalResults
from tests.capture.test_blender_format import make
from tests.scenes import tiny_capture


def changed(**values):
    return dataclasses.replace(tiny_capture(), **values)


def filled(value):
    return np.full(tiny_capture().images.shape[:3], value)


def refused(capture, message):
    with pytest.raises(CaptureError, match=message) as caught:
        gate.checked(capture)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("with_points", [True, False])
def test_depths_of_another_unit_are_refused(with_points):
    good = tiny_capture() if with_points else changed(points=None)
    assert gate.checked(good) is good
    for factor, reason in (
        (1000, r"in millimeters and the cameras in meters, so multiply .* by 0\.001"),
        (100, r"in centimeters and the cameras in meters, so multiply .* by 0\.01"),
        (0.001, r"in meters and the cameras in millimeters, .* by 1000"),
    ):
        depths = np.float32(factor) * good.depths
        refused(dataclasses.replace(good, depths=depths), reason)


def test_depths_in_scene_units_are_told_from_other_units():
    capture = changed(scale=0.02, depths=np.float32(0.02) * tiny_capture().depths)
    refused(capture, "in scene units already, so multiply the depths by 50")


def test_depths_that_are_doubtful_are_said():
    far = changed(depths=np.float32(8) * tiny_capture().depths)
    (note,) = gate.checked(far).notes[len(far.notes) :]
    assert "of depths: the median stored depth is" in note
    none = changed(depths=np.zeros_like(tiny_capture().depths))
    assert "no pixel has one above 0" in gate.checked(none).notes[-1]


def test_depth_files_that_are_not_read_are_said(tmp_path):
    nerfies_format.write(tiny_capture(), tmp_path / "a")
    folder = tmp_path / "a/depth/1x"
    for file in folder.glob("*.npy"):
        file.rename(folder / f"depth_{file.name}")
    capture = formats.load(tmp_path / "a")
    assert capture.depths is None
    assert "no file in depth/1x is named as a frame" in " ".join(capture.notes)
    for file in folder.glob("*.npy"):
        file.rename(file.with_suffix(".png"))
    notes = " ".join(formats.load(tmp_path / "a").notes)
    assert "depth/1x holds no .npy file" in notes


@pytest.mark.parametrize("folder", ["masks", "depth_maps"])
def test_a_folder_that_nothing_names_is_said(tmp_path, folder):
    bare = changed(valid=None, moving=None, depths=None)
    nerfies_format.write(bare, tmp_path / "a")
    quiet = formats.load(tmp_path / "a").notes
    images.write_png(tmp_path / "0.png", filled(True)[0])
    (tmp_path / "a" / folder).mkdir()
    assert formats.load(tmp_path / "a").notes == quiet
    (tmp_path / "0.png").rename(tmp_path / "a" / folder / "0.png")
    (note,) = set(formats.load(tmp_path / "a").notes) - set(quiet)
    assert f"the folder {folder} is not read" in note


def test_masks_named_as_no_frame_are_said(tmp_path):
    nerfies_format.write(tiny_capture(), tmp_path / "a")
    folder = tmp_path / "a/resized_mask/1x"
    for file in folder.iterdir():
        file.rename(folder / f"mask_{file.name}")
    notes = " ".join(formats.load(tmp_path / "a").notes)
    assert "no file in resized_mask/1x is named as a frame" in notes


@pytest.mark.parametrize(
    ("alpha", "words"),
    [(0, "are transparent"), (1, "at most 1 of 255, so no pixel is")],
)
def test_images_that_are_transparent_everywhere_are_refused(alpha, words, tmp_path):
    make(tmp_path, {"": 3})
    for file in (tmp_path / "images").iterdir():
        images.write_png(file, np.full((8, 10, 4), alpha, np.uint8))
    with pytest.raises(CaptureError, match=words):
        formats.load(tmp_path)


def test_depths_of_transforms_are_said_not_to_be_read(tmp_path):
    make(tmp_path, {"": 3}, depth_file_path="depth/0.png")
    notes = " ".join(formats.load(tmp_path).notes)
    assert "depth_file_path of 3 frames is not read; the depth maps in depth" in notes


def test_nothing_observed_or_nothing_static_is_refused():
    capture = tiny_capture()
    refused(changed(valid=filled(False)), "no pixel of the .* training frames")
    valid = filled(True)
    valid[capture.heldout] = False
    refused(changed(valid=valid), "no pixel of the .* held-out frames")
    refused(changed(moving=filled(True)), "leaves no static scene.* inverted")
    external = ExternalResults(capture.size, moving=filled(True))
    refused(changed(external=external), "leaves no static scene")
    moving = filled(True)
    moving[capture.train[0], 0, 0] = False
    assert gate.checked(changed(moving=moving)).moving.any()
