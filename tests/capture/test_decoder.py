"""Decoding in a child: its limits, its end, and what is said of both."""

import os
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import PIL.Image
import pytest

from nerfies_jax.capture import (
    colmap,
    decoder,
    footage,
    images,
    masks,
    photographs,
)
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.colmap_library import library
from nerfies_jax.runtime import children
from tests.capture import test_colmap


@pytest.fixture
def child():
    with decoder.session() as child:
        yield child


def binary_model(root):
    test_colmap.make(root)
    folder = root / "sparse/0"
    library().Reconstruction(str(folder)).write_binary(str(folder))
    for text in folder.glob("*.txt"):
        text.unlink()
    return folder


@pytest.mark.parametrize(
    ("name", "at"),
    [("cameras.bin", 0), ("images.bin", 0), ("points3D.bin", 0), ("points3D.bin", 51)],
)
def test_a_model_that_claims_more_than_it_holds_is_refused(tmp_path, name, at):
    folder = binary_model(tmp_path)
    assert len(colmap.read_model(folder).points) == len(test_colmap.WORLD)
    path = folder / name
    data = path.read_bytes()
    path.write_bytes(data[:at] + (2**40).to_bytes(8, "little") + data[at + 8 :])
    with pytest.raises(CaptureError, match="not a readable COLMAP model"):
        colmap.read_model(folder)


def test_a_decoder_that_allocates_without_end_is_stopped(tmp_path, monkeypatch):
    """Here it is pycolmap, which believes such a count."""
    folder = binary_model(tmp_path)
    path = folder / "points3D.bin"
    path.write_bytes((2**40).to_bytes(8, "little") + path.read_bytes()[8:])
    code = (
        "from nerfies_jax.capture import colmap_tables, decoder_child\n"
        "colmap_tables._check_counts = lambda folder: None\n"
        "decoder_child.main()\n"
    )
    command = [sys.executable, "-c", code]
    start = children.start
    monkeypatch.setattr(
        children, "start", lambda _, **options: start(command, **options)
    )
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CaptureError, match=r"more memory|processor time"):
        colmap.read_model(folder)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 200_000  # kB


def test_a_child_that_was_killed_is_replaced(child, tmp_path):
    with pytest.raises(decoder.DecoderError):
        child.request("exr", path=str(tmp_path / "a.exr"), header_only=True)
    first = child._child
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    with pytest.raises(decoder.DecoderError, match=r"a\.exr"):
        child.request("exr", path=str(tmp_path / "a.exr"), header_only=True)
    assert child._child.pid != first.pid


def test_a_file_that_takes_too_long_is_refused(child, tmp_path, monkeypatch):
    monkeypatch.setattr(decoder, "WALL_SECONDS", 0.01)
    os.mkfifo(tmp_path / "a.exr")  # whoever opens it waits
    with pytest.raises(decoder.DecoderError, match="took too long"):
        child.request("exr", path=str(tmp_path / "a.exr"), header_only=True)


def test_memory_beyond_the_budget_is_refused(child, tmp_path, monkeypatch):
    monkeypatch.setattr(decoder, "MEMORY_BYTES", 10 * 2**20)
    PIL.Image.new("RGB", (6000, 3000)).save(tmp_path / "a.png")
    with pytest.raises(decoder.DecoderError):
        child.request("image", path=str(tmp_path / "a.png"))


def test_large_images_are_decoded_in_the_child(tmp_path, monkeypatch):
    pixels = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
    PIL.Image.fromarray(pixels).save(tmp_path / "a.png")
    monkeypatch.setattr(images, "LARGE_PIXELS", 1000)
    monkeypatch.setattr(images, "decode", None)  # here; the child has its own
    np.testing.assert_array_equal(images.read_pixels(tmp_path / "a.png"), pixels)
    content = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(content[: len(content) // 2])
    with pytest.raises(CaptureError, match=r"a\.png: not a readable image"):
        images.read_pixels(tmp_path / "a.png")


def test_large_masks_are_decoded_in_the_child(tmp_path, monkeypatch):
    mask = np.zeros((30, 40), np.uint8)
    mask[5:9] = 1
    pixels = np.full((30, 40, 4), 255, np.uint8)
    pixels[..., 3] = 255 * mask
    PIL.Image.fromarray(mask).save(tmp_path / "a.png")
    PIL.Image.fromarray(pixels).save(tmp_path / "b.png")
    monkeypatch.setattr(images, "LARGE_PIXELS", 1000)
    monkeypatch.setattr(masks, "decode", None)  # here; the child has its own
    for name in ("a.png", "b.png"):
        np.testing.assert_array_equal(masks.read_mask(tmp_path / name), mask == 1)


@pytest.mark.parametrize("ending", ["heic", "jpg"])
def test_heic_and_large_photographs_are_decoded_in_the_child(
    ending, tmp_path, monkeypatch, child
):
    if ending == "heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    monkeypatch.setattr(images, "LARGE_PIXELS", 1000)
    monkeypatch.setattr(photographs, "decode_upright", None)
    exif = PIL.Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 18
    for row in range(4):
        path = tmp_path / f"{row}.{ending}"
        PIL.Image.new("RGB", (64, 48), (40 * row, 99, 9)).save(path, exif=exif)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) - 60])  # its header is whole
    source_images = footage.from_images(tmp_path, tmp_path / "out")
    assert source_images.names == ("0.png", "1.png", "2.png")
    assert source_images.focal == 0.5
    assert f"1 images left out, not readable, so copy them again: 3.{ending}" in (
        source_images.notes
    )
    shown = images.read_pixels(tmp_path / "out/images/2.png")
    np.testing.assert_allclose(shown.mean((0, 1)), (80, 99, 9), atol=3)


def test_the_child_ends_with_its_parent():
    """Also where the parent is killed and can clean up nothing."""
    code = (
        "import time\n"
        "from nerfies_jax.capture import decoder\n"
        "child = decoder.Decoder()\n"
        "try:\n"
        "    child.request('exr', path='/nowhere.exr', header_only=True)\n"
        "except decoder.DecoderError:\n"
        "    print(child._child.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE
    ) as parent:
        pid = int(parent.stdout.readline())
        os.kill(pid, 0)
        parent.kill()
    for _ in range(100):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        with open(f"/proc/{pid}/stat") as file:
            if file.read().rpartition(")")[2].split()[0] in "ZX":
                return
        time.sleep(0.1)
    raise AssertionError(f"process {pid} is still there")
