"""Videos and photographs become images of one size, upright and in order."""

import os
import struct
from fractions import Fraction

import av
import numpy as np
import PIL.Image
import pytest
import scipy.ndimage

from nerfies_jax.capture import (
    footage,
    frames,
    images,
    masks,
    photographs,
    video,
    video_decoding,
)
from nerfies_jax.capture.capture import CaptureError
from tests.capture.test_video import encoder

pytestmark = pytest.mark.usefixtures("one_child")


def test_the_sharpest_of_each_stretch_is_kept():
    rng = np.random.default_rng(0)
    scores = rng.uniform(80, 120, 60)
    scores[30:] *= 20  # a part of the video with much more texture
    scores[12:18] = 5  # one whole stretch is blurred
    selected_rows, blurred = footage.sharp_rows(scores, np.arange(60) / 30, 10)
    assert blurred == 1
    assert len(selected_rows) == 9
    for stretch in range(10):
        rows = np.arange(6 * stretch, 6 * stretch + 6)
        assert (rows[np.argmax(scores[rows])] in selected_rows) == (stretch != 2)


def test_stretches_are_of_time_and_not_of_frames():
    seconds = np.concatenate([np.arange(0, 1, 0.1), np.arange(1, 2.01, 0.02)])
    selected_rows, _ = footage.sharp_rows(np.ones(len(seconds)), seconds, 10)
    gaps = np.diff(seconds[selected_rows])
    assert len(selected_rows) == 10
    # By number of frames, six to a stretch, the first two would be 0.6 s apart.
    assert gaps.max() < 0.31


def test_sharpness_falls_with_blur():
    noise = np.random.default_rng(0).integers(0, 256, (60, 80)).astype(np.uint8)
    values = [
        footage.sharpness(scipy.ndimage.gaussian_filter(noise, blur))
        for blur in (0, 1, 2, 4)
    ]
    assert values == sorted(values, reverse=True)
    assert values[3] < 0.01 * values[0]


def write_video(path, milliseconds, shape=(32, 48)):
    """A video whose frame k, shown at its own time, is gray 10 k."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=30, options={"crf": "0"})
        stream.height, stream.width = shape
        stream.pix_fmt, stream.codec_context.time_base = "yuv444p", Fraction(1, 1000)
        for number, time in enumerate(milliseconds):
            gray = np.full((*shape, 3), 10 * number, np.uint8)
            frame = av.VideoFrame.from_ndarray(gray, format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def test_a_video_keeps_its_own_times_and_the_masks_of_the_frames_taken(tmp_path):
    milliseconds = [0, 40, 80, 500, 510, 520, 1000]
    write_video(tmp_path / "a.mp4", milliseconds)
    (tmp_path / "given").mkdir()
    for number in range(7):
        mask = np.arange(48) >= 6 * number
        mask = np.repeat(mask[None], 32, 0)
        images.write_png(tmp_path / f"given/{number}.png", mask)
    source_images = footage.from_video(
        tmp_path / "a.mp4", tmp_path, 3, max_side=16, masks=tmp_path / "given"
    )
    times = [int(name[2:10]) for name in source_images.names]
    assert set(times) <= set(milliseconds)
    assert [time // 400 for time in times] == [0, 1, 2]
    assert source_images.seconds == pytest.approx((times[-1] - times[0]) / 1000)
    for name, time in zip(source_images.names, times, strict=True):
        number = milliseconds.index(time)
        image = images.read_pixels(tmp_path / "images" / name)
        assert image.shape == (10, 16, 3)
        assert abs(image.astype(int) - 10 * number).max() <= 3
        mask = masks.read_mask(tmp_path / "masks" / f"{name}.png")
        assert mask.shape == (10, 16)
        assert mask[0].sum() == 16 - 2 * number
    (tmp_path / "given/6.png").unlink()
    with pytest.raises(CaptureError, match="7 frames"):
        footage.from_video(tmp_path / "a.mp4", tmp_path, 3, masks=tmp_path / "given")
    assert len(footage.from_video(tmp_path / "a.mp4", tmp_path / "b").names) == 7
    half = footage.from_video(tmp_path / "a.mp4", tmp_path / "c", per_second=2.0)
    assert len(half.names) == 3
    with pytest.raises(ValueError, match="1 frames to select"):
        footage.from_video(tmp_path / "a.mp4", tmp_path / "d", 1)


def test_colors_are_made_of_the_frames_that_are_kept_alone(tmp_path, monkeypatch):
    write_video(tmp_path / "a.mp4", range(0, 1000, 40))
    made, pixels = [], video_decoding._pixels
    monkeypatch.setattr(
        video_decoding, "_pixels", lambda one: made.append(one) or pixels(one)
    )
    path = str(tmp_path / "a.mp4")
    answers = [*video_decoding.frames(path, 99, [2, 5], False, "skip")]
    assert [bool(arrays) for _, arrays in answers] == [False, False, True] * 2
    assert len(made) == 2


def test_frames_stay_in_order_where_times_are_those_of_decoding(tmp_path):
    """H.264 in .avi: B-frames are decoded out of turn, and nothing else is stored."""
    noise = np.random.default_rng(0).integers(0, 40, (32, 48, 3)).astype(np.uint8)
    options = {"bf": "3", "b_strategy": "0"}
    with encoder(tmp_path / "a.avi", (48, 32), **options) as (_, put):
        for number in range(12):
            frame = av.VideoFrame.from_ndarray(noise + np.uint8(15 * number), "rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 10)
            put(frame)
    times = [seconds for seconds, _ in video.read_video(tmp_path / "a.avi")]
    assert min(np.diff(times)) < 0
    source_images = footage.from_video(tmp_path / "a.avi", tmp_path / "out", 12)
    shown = [
        images.read_pixels(tmp_path / "out/images" / name).mean()
        for name in sorted(source_images.names)
    ]
    assert len(shown) == 12
    assert min(np.diff(shown)) > 10


def test_an_image_of_floats_is_refused_by_name(tmp_path):
    for name in ("0.tif", "1.tif", "2.tif"):
        PIL.Image.fromarray(np.ones((32, 32), np.float32)).save(tmp_path / name)
    with pytest.raises(CaptureError, match=r"0\.tif: .*32-bit floats.*8 or 16 bits"):
        footage.from_images(tmp_path, tmp_path / "out")
    deep = np.full((32, 32), 70_000, np.int32)
    for name in ("0.tif", "1.tif", "2.tif"):
        PIL.Image.fromarray(deep).save(tmp_path / name)
    with pytest.raises(CaptureError, match=r"0\.tif: 32-bit gray up to 70000"):
        footage.from_images(tmp_path, tmp_path / "out")


def test_masks_of_zero_and_one_are_written_as_meant(tmp_path):
    (tmp_path / "masks").mkdir()
    mask = np.ones((32, 32), np.uint8)
    mask[8:24, 8:24] = 0
    for name in ("0.png", "1.png", "2.png"):
        image = np.full((32, 32, 3), 90, np.uint8)
        PIL.Image.fromarray(image).save(tmp_path / name)
        PIL.Image.fromarray(mask).save(tmp_path / "masks" / name)
    source_images = footage.from_images(
        tmp_path, tmp_path / "out", masks=tmp_path / "masks"
    )
    written = images.read_pixels(tmp_path / "out/masks/1.png.png")[..., 0]
    np.testing.assert_array_equal(written, 255 * mask)
    assert "3 masks of values 0 and 1 (white); 25.0%" in source_images.notes[-1]


def test_what_is_cut_out_of_an_image_is_black(tmp_path):
    """The color that an editor leaves behind transparency is not to be matched."""
    pixels = np.full((32, 32, 4), 200, np.uint8)
    pixels[:, :, 3] = np.repeat([0, 255], 16)[:, None]
    for name in ("0.png", "1.png", "2.png"):
        PIL.Image.fromarray(pixels).save(tmp_path / name)
    footage.from_images(tmp_path, tmp_path / "out")
    read = images.read_pixels(tmp_path / "out/images/0.png")
    assert (read[:16] == 0).all()
    assert (read[16:] == 200).all()


def test_photographs_come_upright_of_one_size_whatever_their_ending(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(photographs, "heic_is_read", lambda: False)
    rng = np.random.default_rng(0)
    upright = rng.integers(0, 256, (5, 8, 8, 3)).astype(np.uint8)
    upright = upright.repeat(4, 1).repeat(8, 2)  # 64 x 32, flat blocks
    stored = [
        np.rot90(image, k) for image, k in zip(upright, (0, 1, 0, 0, 0), strict=True)
    ]
    turned = PIL.Image.Exif()
    turned[0x0112] = 6  # a viewer turns it by a quarter to the right
    turned.get_ifd(0x8769)[0xA405] = 27  # mm on 36
    folder = tmp_path / "photographs"
    folder.mkdir()
    best = {"quality": 100, "subsampling": 0}
    options = {"1.JPG": {"exif": turned, **best}, "2.WebP": {"lossless": True}}
    names = ("0.PNG", "1.JPG", "2.WebP", "10.tif", "3.png")
    for image, name in zip(stored, names, strict=True):
        PIL.Image.fromarray(image).save(folder / name, **options.get(name, {}))
    PIL.Image.fromarray(upright[0, :, :16]).save(folder / "small.png")
    (folder / "4.HEIC").write_bytes(b"")
    (folder / "notes.txt").touch()
    source_images = footage.from_images(folder, tmp_path / "out", max_side=32)
    assert source_images.names == ("0.png", "1.png", "2.png", "3.png", "10.png")
    assert source_images.focal == 27 / 36
    left_out = " ".join(source_images.notes)
    assert "4.HEIC" in left_out
    assert "small.png" in left_out
    assert "notes.txt" not in left_out
    for name, row in zip(source_images.names, (0, 1, 2, 4, 3), strict=True):
        pixels = images.read_pixels(tmp_path / "out/images" / name)
        exact = upright[row].reshape(16, 2, 32, 2, 3).mean((1, 3))
        assert pixels.shape == (16, 32, 3)
        assert np.abs(pixels - exact).max() <= (4 if name == "1.png" else 1), name


def test_a_folder_is_told_by_what_is_in_it(tmp_path):
    assert footage.kind_of(tmp_path) is None
    (tmp_path / "a.MOV").touch()
    assert footage.kind_of(tmp_path / "a.MOV") == "video"
    for name in ("a.jpg", "b.JPG"):
        (tmp_path / name).write_bytes(b"broken")
    assert footage.kind_of(tmp_path) == "images"
    with pytest.raises(CaptureError, match=r"0 images.*not readable.*: a\.jpg, b\."):
        footage.from_images(tmp_path, tmp_path / "out")


def test_what_cannot_be_read_is_left_out_and_what_is_hidden_is_no_image(tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    for row in range(5):
        noise = np.random.default_rng(row).integers(0, 256, (32, 48, 3))
        PIL.Image.fromarray(noise.astype(np.uint8)).save(folder / f"{row}.jpg")
    (folder / "._0.jpg").write_bytes(b"of macOS")
    (folder / "album.jpg").mkdir()
    (folder / "1.jpg").write_bytes(b"broken")
    (folder / "2.jpg").write_bytes((folder / "2.jpg").read_bytes()[:1000])  # its header
    # Of an old archive, its name in no encoding that is known.
    (folder / "4.jpg").rename(folder / os.fsdecode(b"f\xfcr.jpg"))
    # Of a phone's best camera, or a broken header; Pillow raises what is no OSError.
    for name, size in {"5.bmp": (12_240, 16_320), "6.bmp": (9_000, 12_000)}.items():
        PIL.Image.new("RGB", (48, 32)).save(folder / name)
        header = bytearray((folder / name).read_bytes())
        header[18:26] = struct.pack("<2i", *size)
        (folder / name).write_bytes(header)
    assert len(footage.images_in(folder)) == 7
    assert len(frames.images_in(folder, footage.PLAIN)) == 7
    source_images = footage.from_images(folder, tmp_path / "out")
    assert source_images.names == ("0.png", "3.png", "für.png")
    left_out = [note.rpartition(": ")[2] for note in source_images.notes]
    assert left_out == ["1.jpg", "5.bmp, 6.bmp", "2.jpg"]
    written = sorted(path.name for path in (tmp_path / "out/images").iterdir())
    assert written == ["0.png", "3.png", "für.png"]
    (folder / "3.jpg").unlink()
    with pytest.raises(CaptureError, match=r"2 images; .*at least 3.*1\.jpg.*2\.jpg"):
        footage.from_images(folder, tmp_path / "again")


def test_what_files_say_of_a_lens_may_be_anything(tmp_path):
    values = {"0.jpg": (27, 35), "1.jpg": 0, "2.jpg": 18, "3.jpg": "wide"}
    for name, value in values.items():
        exif = PIL.Image.Exif()
        exif[0x0112] = 9  # no orientation that there is
        exif.get_ifd(0x8769)[0xA405] = value
        PIL.Image.new("RGB", (48, 32)).save(tmp_path / name, exif=exif)
    source_images = footage.from_images(tmp_path, tmp_path / "out")
    assert source_images.names == ("0.png", "1.png", "2.png", "3.png")
    assert source_images.focal == 18 / 36


def test_two_frames_of_one_time_cost_one_of_them(tmp_path, monkeypatch):
    def read(path, gray=False, rows=None, damaged="refuse"):
        for row in range(30) if rows is None else sorted(rows):
            # The fifth frame comes a tenth of a millisecond after the fourth.
            seconds = row / 30 if row != 4 else 0.1001
            yield seconds, np.full((32, 48) if gray else (32, 48, 3), row, np.uint8)

    monkeypatch.setattr(footage, "read_video", read)
    monkeypatch.setattr(footage, "transfer_of", lambda video: None)
    monkeypatch.setattr(footage, "notes_of", lambda *_: ())
    source_images = footage.from_video(tmp_path / "a.mp4", tmp_path, 30)
    assert len(source_images.names) == len(set(source_images.names)) == 29
    monkeypatch.setattr(footage, "OWN_TIMES", 0.99)
    with pytest.raises(CaptureError, match="its frames have no times"):
        footage.from_video(tmp_path / "a.mp4", tmp_path / "b", 30)
