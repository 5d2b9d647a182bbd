"""Recognizing what a folder holds, and saying what was looked for."""

import inspect
import subprocess
import sys

import numpy as np
import pytest

from nerfies_jax import capture as room
from nerfies_jax.capture import (
    blender_format,
    colmap,
    formats,
    llff_format,
    nerfies_format,
    world_points,
)
from nerfies_jax.capture.capture import CaptureError


def test_a_folder_that_is_no_capture_lists_what_was_looked_for(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(CaptureError) as caught:
        room.load(tmp_path)
    message = str(caught.value)
    for words in (
        str(tmp_path),
        "scene.json",
        "transforms*.json",
        "sparse/0/cameras.bin",
    ):
        assert words in message
    assert "\n" not in message


def test_what_is_no_capture_yet_is_refused_with_the_way_out(tmp_path):
    with pytest.raises(CaptureError, match="no such file or folder"):
        room.load(tmp_path / "nowhere")
    (tmp_path / "video.mp4").write_bytes(b"")
    with pytest.raises(CaptureError, match="a file, not a capture"):
        room.load(tmp_path / "video.mp4")
    assert issubclass(CaptureError, ValueError)
    for name in ("a.jpg", "b.HEIC"):
        (tmp_path / name).touch()
    # Below it lies what was made of them before.
    made = tmp_path / "runs/a-capture/colmap/sparse/0"
    made.mkdir(parents=True)
    (made / "cameras.bin").touch()
    with pytest.raises(CaptureError, match=r"2 images without.*prepare images"):
        room.load(tmp_path)


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (("scene.json", "camera/0.json"), "nerfies"),
        # Nerfies' own folders may hold the COLMAP model they came from.
        (("scene.json", "camera/0.json", "colmap/sparse/0/cameras.bin"), "nerfies"),
        (("transforms.json",), "blender"),
        (("transforms_train.json", "sparse/0/cameras.bin"), "blender"),
        (("sparse/0/cameras.txt",), "colmap"),
        (("colmap/sparse/0/cameras.bin",), "colmap"),
        (("sparse/1/cameras.bin",), "colmap"),
        (("cameras.bin",), "colmap"),
        (("poses_bounds.npy",), "llff"),
        # LLFF's folders may hold the model that their poses came from.
        (("poses_bounds.npy", "sparse/0/cameras.bin"), "colmap"),
    ],
)
def test_what_is_recognized(tmp_path, files, expected):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert formats.recognize(tmp_path).name == expected


def test_every_reader_takes_the_common_options():
    common = set(inspect.signature(formats.load).parameters) - {"options", "times"}
    for reader in (nerfies_format, blender_format, colmap, llff_format):
        assert common <= set(inspect.signature(reader.read).parameters)


def test_load_passes_its_options_on(monkeypatch, tmp_path):
    (tmp_path / "transforms.json").touch()
    seen = {}

    def record(path, **options):
        seen.update(options)
        raise CaptureError("seen")

    monkeypatch.setattr(blender_format, "read", record)
    with pytest.raises(CaptureError, match="seen"):
        room.load(tmp_path, factor=2, heldout="val", background=(0.0, 0.0, 0.0))
    assert seen == {
        "factor": 2,
        "max_side": None,
        "heldout": "val",
        "missing": "refuse",
        "background": (0.0, 0.0, 0.0),
    }


@pytest.mark.full
def test_importing_the_room_loads_no_decoder():
    code = (
        "import sys, nerfies_jax.capture, nerfies_jax.capture.formats\n"
        "heavy = {'skimage', 'av', 'OpenEXR', 'pycolmap', 'plyfile', 'scipy'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() in ("[]", "['scipy']"), done.stderr  # jax may load scipy


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "size", "splits", "within_px"),
    [
        # The data's own card: median 0.16 px at this size; with shuffled cameras 24.
        ("backpack_clip", (184, 240), None, 0.165),
        # 0.42 px; with shuffled cameras 51.
        ("nrnerf_bookshelf", (512, 384), (75, 11), 0.43),
    ],
)
def test_a_real_capture_projects_its_points_where_they_were_seen(
    name, size, splits, within_px, data_dir
):
    capture = room.load(data_dir / name)
    assert capture.size == size
    assert splits in (None, (capture.train.size, capture.heldout.size))
    assert splits or any("black borders" in note for note in capture.notes)
    seen = np.load(data_dir / name / "points_tri.npz")
    position = np.float32((seen["xyz"] - np.array(capture.center)) * capture.scale)
    errors = []
    for row in range(len(capture.ids)):
        pixel, *_ = world_points.pixels_of(capture.cameras, row, position, size)
        here = seen["obs_image"] == row
        errors.append(pixel[seen["obs_point"][here]] - seen["obs_xy"][here])
    assert np.median(np.linalg.norm(np.concatenate(errors), axis=1)) < within_px
