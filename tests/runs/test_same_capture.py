"""A run goes on with the capture that it was begun with, wherever that lies now."""

import dataclasses
import json
import re

import numpy as np
import pytest

from nerfies_jax import runs
from nerfies_jax.capture import capture as captures
from nerfies_jax.capture import nerfies_format
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.external import ExternalFiles
from nerfies_jax.runs import run_folder, same_capture
from nerfies_jax.runs.config import CaptureSource, RunConfig
from tests import scenes

CAPTURE = scenes.tiny_capture()


def with_images(change):
    images = CAPTURE.images.copy()
    change(images)
    return dataclasses.replace(CAPTURE, images=images)


def with_cameras(**changes):
    cameras = CAPTURE.cameras._replace(**changes)
    return dataclasses.replace(CAPTURE, cameras=cameras)


def test_what_another_decoder_or_processor_rounds_is_the_same(tmp_path):
    same_capture.record(tmp_path, CAPTURE)
    same_capture.check(tmp_path, CAPTURE)
    noise = np.random.default_rng(0).integers(-2, 3, CAPTURE.images.shape)
    images = np.clip(CAPTURE.images + noise, 0, 255).astype(np.uint8)
    position = CAPTURE.cameras.position * np.float32(1 + 1e-6)
    read = with_cameras(position=position)
    same_capture.check(tmp_path, dataclasses.replace(read, images=images))


def _of_another_frame(images):
    images[3] = images[4]


def _retouched(images):
    images[3, :6, :6] = 255 - images[3, :6, :6]


FOURTH = CAPTURE.ids[3]
FOCAL = CAPTURE.cameras.focal_px * np.where(np.arange(len(CAPTURE.ids)) == 3, 1.01, 1)
OTHERS = {
    f"images have changed (first at frame {FOURTH})": [
        with_images(_of_another_frame),
        with_images(_retouched),
    ],
    f"camera focal_px have changed (first at frame {FOURTH})": [
        with_cameras(focal_px=FOCAL.astype(np.float32))
    ],
    "the names of frames have changed": [
        captures.select(CAPTURE, np.arange(1, len(CAPTURE.ids)))
    ],
    "the dimensions of the images have changed": [captures.downscale(CAPTURE, 2)],
    "the training frames have changed": [
        dataclasses.replace(CAPTURE, train=CAPTURE.train[1:])
    ],
    "the held-out frames have changed": [
        dataclasses.replace(CAPTURE, heldout=CAPTURE.heldout[:0])
    ],
    "times have changed": [dataclasses.replace(CAPTURE, times=1 - CAPTURE.times)],
    "bounds, scale or center have changed": [
        dataclasses.replace(CAPTURE, far=1.01 * CAPTURE.far)
    ],
}


@pytest.mark.parametrize(
    ("words", "other"), [(words, one) for words, many in OTHERS.items() for one in many]
)
def test_what_differs_is_named(words, other, tmp_path):
    same_capture.record(tmp_path, CAPTURE)
    with pytest.raises(CaptureError) as refusal:
        same_capture.check(tmp_path, other)
    assert words in str(refusal.value)
    assert str(tmp_path) in str(refusal.value)


def test_a_run_of_a_former_version_is_taken_at_its_word(tmp_path):
    same_capture.check(tmp_path, CAPTURE)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 and no more", None])
def test_a_damaged_record_is_named(content, tmp_path):
    path = tmp_path / same_capture.FILE
    if content is None:
        np.savez(path, times=np.zeros(3))
    else:
        path.write_bytes(content)
    with pytest.raises(CaptureError, match=r"capture\.npz: not a valid description"):
        same_capture.check(tmp_path, CAPTURE)


@pytest.fixture
def begun(tmp_path):
    """The folders of a capture and of a run that was begun with it."""
    source, folder = tmp_path / "capture", tmp_path / "run"
    nerfies_format.write(CAPTURE, source)
    folder.mkdir()
    run = runs.new_run(RunConfig("splats-static", CaptureSource(source), 60))
    runs.save_config(folder, run)
    same_capture.record(folder, run.capture)
    return source, folder


def test_a_capture_may_be_moved(begun):
    source, folder = begun
    path = folder / run_folder.CONFIG
    before = json.loads(path.read_text())
    there = source.rename(source.with_name("elsewhere"))
    with pytest.raises(ValueError, match="was moved, pass its new path"):
        runs.saved_run(folder)
    runs.saved_run(folder, new_source={"capture": there})
    assert runs.saved_run(folder).capture.path == there
    before["config"]["source"]["capture"] = str(there)
    assert json.loads(path.read_text()) == before


def test_another_capture_is_not_taken_for_a_moved_one(begun):
    source, folder = begun
    there = source.with_name("elsewhere")
    nerfies_format.write(with_images(_retouched), there)
    before = (folder / run_folder.CONFIG).read_bytes()
    with pytest.raises(runs.Refused, match="capture: saved"):  # the old one is there
        runs.resume(folder, expected={"capture": there})
    source.rename(source.with_name("lost"))
    words = re.escape(f"images have changed (first at frame {FOURTH})")
    with pytest.raises(runs.Refused, match=words):
        runs.resume(folder, expected={"capture": there})
    assert (folder / run_folder.CONFIG).read_bytes() == before


def test_files_of_other_tools_may_be_moved(begun):
    source, folder = begun
    masks = source.with_name("masks")
    run = runs.saved_run(folder)
    named = CaptureSource(source, files=ExternalFiles(masks=masks))
    runs.save_config(
        folder, run._replace(config=dataclasses.replace(run.config, source=named))
    )
    there = source.with_name("other_masks")
    wanted = {"files": ExternalFiles(masks=there)}
    with pytest.raises(runs.Refused, match="files: saved"):  # not there either
        runs.resume(folder, expected=wanted)
    there.mkdir()
    with pytest.raises(runs.Refused, match="other_masks"):  # taken, and empty
        runs.resume(folder, expected=wanted)


def test_times_of_a_file_are_of_captures_and_of_no_built_in_scene(tmp_path):
    nerfies_format.write(CAPTURE, tmp_path / "a")
    file = tmp_path / "times.txt"
    rows = zip(CAPTURE.ids, CAPTURE.times.tolist(), strict=True)
    file.write_text("".join(f"{name} {7 * time**2}\n" for name, time in rows))
    source = CaptureSource(capture=tmp_path / "a", files=ExternalFiles(times=file))
    read = runs.stored_capture(source)
    np.testing.assert_allclose(read.times, CAPTURE.times**2, atol=1e-6)
    assert read.external is None
    with pytest.raises(ValueError, match="a built-in scene defines its own"):
        runs.stored_capture(CaptureSource(files=ExternalFiles(times=file)))
