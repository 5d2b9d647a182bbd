"""Memory of frames: one copy on the CPU, and what is said of it beforehand."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.capture import formats, frame_memory
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.images import read_image, write_png
from nerfies_jax.runtime import events
from nerfies_jax.scene import steps
from tests import scenes
from tests.capture.test_capture import make
from tests.test_devices import model_of
from tests.training import toy


@pytest.mark.full
def test_large_captures_are_trained_on_where_they_lie(monkeypatch):
    capture = make(frames=6)
    images = frame_memory.allocate(capture.images.shape, np.uint8)
    images[:] = capture.images
    aligned = dataclasses.replace(capture, images=images)
    copied = evaluation.frames_of(aligned)
    monkeypatch.setattr(frame_memory, "LEAST_SHARED_BYTES", 0)
    shared = evaluation.frames_of(aligned)
    assert shared.images.unsafe_buffer_pointer() == images.ctypes.data
    assert copied.image_rows is None
    assert len(copied.images) == len(capture.train) < len(shared.images)
    both = [
        steps.draw_batch(frames, 64, jax.random.key(0)) for frames in (shared, copied)
    ]
    for one, other in zip(*map(jax.tree.leaves, both), strict=True):
        np.testing.assert_array_equal(one, other)
    image, own = capture.images[:1].nbytes, frame_memory.capture_bytes(aligned)
    assert frame_memory.frame_bytes(aligned) == own + 8 * image
    monkeypatch.setattr(frame_memory, "LEAST_SHARED_BYTES", 2**40)
    copies = 2 * len(capture.train)  # CPU devices share one
    assert frame_memory.frame_bytes(aligned, 4) == own + copies * image


@pytest.fixture
def on_disk(monkeypatch, tmp_path):
    """Let arrays of any size be mapped from files in a folder."""
    monkeypatch.setattr(frame_memory, "MOST_IN_MEMORY", 0)
    monkeypatch.setattr(frame_memory, "FOLDER", tmp_path / "files")
    return tmp_path / "files"


def test_large_captures_are_streamed_from_a_file_that_is_deleted(tmp_path, on_disk):
    frames(tmp_path / "capture", 4, (64, 48))
    messages = []
    with events.subscribe(messages.append):
        loaded = formats.load(tmp_path / "capture")
    assert frame_memory.is_mapped(loaded.images)
    (line,) = (m["text"] for m in messages if m["kind"] == "message")
    assert line.startswith("frames are streamed from disk: 4 images of 64x48 take ")
    assert list(on_disk.iterdir()) == []  # also if the process is killed
    image = read_image(tmp_path / "capture/images/0.png")[0]
    for _ in range(2):
        np.testing.assert_array_equal(loaded.images, 4 * [image])
        time.sleep(2 * frame_memory.UNMAP_SECONDS)  # its pages are unmapped meanwhile


def test_frames_that_do_not_fit_on_the_disk_are_refused(tmp_path, on_disk, monkeypatch):
    frames(tmp_path / "capture", 4, (64, 48))
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=100))
    with pytest.raises(
        CaptureError, match="images: 4 images of 64x48 need a temporary"
    ):
        formats.load(tmp_path / "capture")


def test_frames_that_do_not_fit_on_the_device_are_refused(monkeypatch):
    statistics = {"bytes_limit": 5 * 300 * 200 * 4}  # five frames with their masks
    device = SimpleNamespace(memory_stats=lambda: statistics)
    monkeypatch.setattr(jax, "local_devices", lambda: [device])
    monkeypatch.setattr(frame_memory, "is_shared", lambda capture: False)
    capture = make(frames=6, size=(300, 200))
    evaluation.frames_of(capture)
    statistics["bytes_limit"] -= 1
    needed = "the training frames need 0.0 GiB of memory on the device, which has 0.0"
    with pytest.raises(ValueError, match=needed):
        evaluation.frames_of(capture)


@pytest.mark.full
@pytest.mark.parametrize("spec", [scenes.TINY_SPLATS, scenes.TINY_FIELD])
def test_streamed_frames_train_as_those_in_memory(spec, on_disk, monkeypatch):
    """Bit for bit."""
    capture = scenes.tiny_capture()
    images = frame_memory.allocate(capture.images.shape, np.uint8)
    images[:] = capture.images
    states = []
    for least, each in (
        (0, dataclasses.replace(capture, images=images)),
        (1e9, capture),
    ):
        monkeypatch.setattr(frame_memory, "LEAST_SHARED_BYTES", least)
        model, state, frames = model_of(spec, each)
        assert (frames.image_rows is None) == (least > 0)
        states.append(toy.fit(frames, state, model, steps=5).state)
    for one, other in zip(*map(jax.tree.leaves, states), strict=True):
        assert jnp.array_equal(one, other)


MEASURE = """
import json, sys
import jax
from nerfies_jax import capture, evaluation
from nerfies_jax.capture import frame_memory

def status(key):
    with open("/proc/self/status") as file:
        (line,) = (line for line in file if line.startswith(key))
    return 1024 * int(line.split()[1])

small, large = sys.argv[1:]
evaluation.frames_of(capture.load(small))  # loads libraries
with open("/proc/self/clear_refs", "w") as file:
    file.write("5")  # forget the peak
before = status("VmRSS")
loaded = capture.load(large)
jax.block_until_ready(evaluation.frames_of(loaded))
grown = status("VmHWM") - before
estimate = frame_memory.frame_bytes(loaded)
print(json.dumps([loaded.images.nbytes, grown, estimate]))
"""


def frames(root, count, size):
    """Poses around the origin, with one image under many names."""
    (root / "images").mkdir(parents=True)
    y, x = np.mgrid[: size[1], : size[0]]
    write_png(root / "images/0.png", np.stack([x, y, x + y], -1).astype(np.uint8))
    entries = []
    for row in range(count):
        if row:
            os.link(root / "images/0.png", root / f"images/{row}.png")
        angle = 0.01 * row
        c, s = float(np.cos(angle)), float(np.sin(angle))
        pose = [[c, 0, s, 4 * s], [0, 1, 0, 0], [-s, 0, c, 4 * c], [0, 0, 0, 1]]
        name = f"images/{row}.png"
        time = row / (count - 1)
        entries.append({"file_path": name, "time": time, "transform_matrix": pose})
    table = {"camera_angle_x": 0.9, "frames": entries}
    (root / "transforms.json").write_text(json.dumps(table))


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/clear_refs"), reason="Linux alone")
def test_frames_take_their_own_bytes_and_no_more(tmp_path):
    """300 frames of 1280x720 took 1.04 times their 791 MB, and 3.7 times before."""
    frames(tmp_path / "small", 4, (64, 48))
    frames(tmp_path / "large", 80, (1280, 720))
    folders = [str(tmp_path / name) for name in ("small", "large")]
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, *folders], capture_output=True, check=True
    )
    raw, grown, estimate = json.loads(done.stdout.splitlines()[-1])
    assert grown < 1.3 * raw
    assert 0.9 < estimate / grown < 1.1
