"""Video: round trips, odd sizes, times, and broken files."""

import contextlib
import os
import struct
import subprocess
import sys

import av
import numpy as np
import pytest

from nerfies_jax.capture import footage, high_dynamic_range, video
from nerfies_jax.capture.capture import CaptureError

pytestmark = pytest.mark.usefixtures("one_child")


@contextlib.contextmanager
def encoder(path, size, codec="h264", pixels="yuv420p", **options):
    """Yields a stream of ten frames a second, and a function that writes one to it."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=options)
        (stream.width, stream.height), stream.pix_fmt = size, pixels
        yield stream, lambda frame: container.mux(stream.encode(frame))
        container.mux(stream.encode())


def make_frames(count=8, size=(31, 45)):
    y, x = np.mgrid[: size[0], : size[1]]
    frames = [np.stack([x * 5, y * 8, x * 0 + 25 * k], -1) for k in range(count)]
    return [np.clip(frame, 0, 255).astype(np.uint8) for frame in frames]


def test_colors_and_times_survive_odd_sizes(tmp_path):
    frames = make_frames()
    video.write_video(tmp_path / "a.mp4", iter(frames), 12.5, quality=2)
    decoded = list(video.read_video(tmp_path / "a.mp4"))
    assert len(decoded) == 8
    assert decoded[0][1].shape == (32, 46, 3)  # padded to even
    for number, (seconds, frame) in enumerate(decoded):
        assert seconds == pytest.approx(number / 12.5, abs=1e-4)
        error = np.abs(frame[:31, :45].astype(int) - frames[number])
        # Chroma is halved and everything quantized: 2 levels on smooth images.
        assert error.mean() < 3
        np.testing.assert_allclose(frame[31], frame[30], atol=12)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


WRITES = """
import sys
import numpy as np
from nerfies_jax.capture import video
y, x, k = np.ogrid[:48, :64, :14]
waves = np.sin((x + 4 * k)[..., None] / [7, 9, 11])
waves = waves + np.cos((y - 3 * k)[..., None] / [5, 8, 13])
frames = (127 + 60 * waves).astype(np.uint8)
video.write_video(sys.argv[1], np.moveaxis(frames, 2, 0), 12)
"""


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="glibc fills new memory if asked")
def test_equal_frames_make_equal_videos_whatever_was_in_memory(tmp_path):
    contents = []
    for fill in ("1", "85"):
        path = tmp_path / f"{fill}.mp4"
        environment = os.environ | {"MALLOC_PERTURB_": fill}
        subprocess.run(
            [sys.executable, "-c", WRITES, path], env=environment, check=True
        )
        contents.append(path.read_bytes())
    assert contents[0] == contents[1]


def test_the_file_says_which_colors_it_holds(tmp_path):
    video.write_video(tmp_path / "a.mp4", make_frames())
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0].codec_context
        tags = (stream.color_primaries, stream.colorspace, stream.color_range)
        assert tags == (1, 1, 1)
        assert stream.pix_fmt == "yuv420p"


def test_at_most_so_many_frames_are_read(tmp_path):
    video.write_video(tmp_path / "a.mp4", make_frames(), 10)
    assert len(list(video.read_video(tmp_path / "a.mp4", most=2))) == 2


@pytest.mark.parametrize(
    ("turn", "expected", "mark"),
    [(90, (46, 32), (-4, 4)), (180, (32, 46), (-4, -4)), (-90, (46, 32), (4, -4))],
)
def test_a_phones_rotation_is_carried_out(tmp_path, turn, expected, mark):
    frame = np.zeros((32, 46, 3), np.uint8)
    frame[:8, :8] = 255  # a mark in the top left corner of what is stored
    with encoder(tmp_path / "a.mp4", (46, 32)) as (stream, put):
        if not hasattr(stream, "set_display_rotation"):
            pytest.skip("this PyAV cannot write the tag")
        stream.set_display_rotation(turn)  # degrees against the clock
        for _ in range(3):
            put(av.VideoFrame.from_ndarray(frame, format="rgb24"))
    _, decoded = next(iter(video.read_video(tmp_path / "a.mp4")))
    assert decoded.shape[:2] == expected
    assert decoded[mark].min() > 200
    assert decoded[-mark[0], mark[1]].max() < 60


@pytest.mark.parametrize(
    ("across", "down", "expected"), [(-1, 1, "GRWB"), (1, -1, "BWRG"), (-1, -1, "WBGR")]
)
def test_a_mirror_is_no_turn(tmp_path, across, down, expected):
    """Quadrants R G over B W; the matrix of the track (ISO 14496-12) mirrors them."""
    colors = {"R": (255, 0, 0), "G": (0, 255, 0), "B": (0, 0, 255), "W": (255,) * 3}
    image = np.reshape([*colors.values()], (2, 2, 3)).astype(np.uint8)
    image = image.repeat(16, 0).repeat(24, 1)
    video.write_video(tmp_path / "a.mp4", [image] * 2, quality=2)
    data = bytearray((tmp_path / "a.mp4").read_bytes())
    start = data.index(b"tkhd") + 44
    one, shift = 1 << 16, (48 << 16 if across < 0 else 0, 32 << 16 if down < 0 else 0)
    matrix = (across * one, 0, 0, 0, down * one, 0, *shift, 1 << 30)
    upright = (one, 0, 0, 0, one, 0, 0, 0, 1 << 30)
    assert struct.unpack_from(">9i", data, start) == upright
    struct.pack_into(">9i", data, start, *matrix)
    (tmp_path / "a.mp4").write_bytes(data)
    _, decoded = next(iter(video.read_video(tmp_path / "a.mp4")))
    _, gray = next(iter(video.read_video(tmp_path / "a.mp4", gray=True)))
    for mark, (y, x) in zip(expected, np.ndindex(2, 2), strict=True):
        at = (8 + 16 * y, 12 + 24 * x)
        assert np.abs(decoded[at] - np.array(colors[mark])).max() < 12
        assert (gray[at] > 240) == (mark == "W")


@pytest.mark.parametrize(
    ("height", "space"), [(718, "ITU601"), (720, "ITU709")], ids=["small", "hd"]
)
def test_a_video_without_color_tags_has_those_of_its_size(tmp_path, height, space):
    color = np.array([200, 30, 40])
    image = np.zeros((height, 64, 3), np.uint8) + color.astype(np.uint8)
    with encoder(tmp_path / "a.mp4", (64, height)) as (_, put):
        for _ in range(2):
            coded = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(
                format="yuv420p", dst_colorspace=space, dst_color_range="MPEG"
            )
            coded.colorspace = 2  # not told
            put(coded)
    _, decoded = next(iter(video.read_video(tmp_path / "a.mp4")))
    # The other matrix is off by up to 30.
    assert np.abs(decoded[100, 30] - color).max() <= 4


def test_of_rows_alone_nothing_behind_the_last_is_decoded(tmp_path):
    with encoder(tmp_path / "a.mov", (45, 31), "png", "rgb24") as (_, put):
        for image in make_frames(60):
            put(av.VideoFrame.from_ndarray(image, format="rgb24"))
    data = bytearray((tmp_path / "a.mov").read_bytes())
    where = -1
    for _ in range(40):  # 16 threads, at most, decode ahead
        where = data.index(b"IHDR", where + 1)
    data[where - 12 : where] = bytes(12)  # its signature
    (tmp_path / "a.mov").write_bytes(data)
    with pytest.raises(CaptureError, match="not a readable video"):
        list(video.read_video(tmp_path / "a.mov"))
    shown = list(video.read_video(tmp_path / "a.mov", rows=(1, 6)))
    for (_, image), number in zip(shown, (1, 6), strict=True):
        np.testing.assert_array_equal(image, make_frames()[number])


def pq_code(nits):
    """SMPTE ST 2084, forwards, as it is printed there."""
    power = (np.asarray(nits) / 10_000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


def srgb(linear):
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055
    )


def test_high_dynamic_range_keeps_what_is_no_brighter_than_half_of_white():
    """Colors of sRGB at 95 nits and less, coded as PQ in the primaries of BT.2020."""
    colors = np.array([[1, 1, 1], [0.9, 0.1, 0.05], [0.1, 0.5, 1], [0, 0, 0]])
    # ITU-R BT.2087-0, equation for linear BT.709 to linear BT.2020
    to_wide = [
        [0.6274, 0.3293, 0.0433],
        [0.0691, 0.9195, 0.0114],
        [0.0164, 0.0880, 0.8956],
    ]
    for nits in (95, 30, 2):
        code = np.round(65535 * pq_code(nits * colors @ np.transpose(to_wide)))
        shown = high_dynamic_range.tone_mapped(code.astype(np.uint16), "PQ")
        expected = 255 * srgb(nits / 203 * colors)
        # A level of rounding, and one of matrices of four digits at dark colors
        assert np.abs(shown - expected).max() < 2
    gray = np.repeat(np.linspace(0, 1, 4001)[:, None], 3, axis=1)
    for transfer in ("PQ", "HLG"):
        ramp = high_dynamic_range.tone_mapped(
            np.round(65535 * gray).astype(np.uint16), transfer
        )
        assert (np.diff(ramp[:, 1].astype(int)) >= 0).all()
        assert (ramp[0].max(), ramp[-1].min()) == (0, 255)
        assert np.ptp(ramp.astype(int), axis=1).max() <= 1
    # White paper has the code 0.75 of HLG and 0.5807 of PQ (BT.2408-7, table 1).
    paper = [
        high_dynamic_range.tone_mapped(np.uint16([round(65535 * code)] * 3), transfer)
        for code, transfer in ((0.75, "HLG"), (0.5807, "PQ"))
    ]
    assert np.abs(paper[0].astype(int) - paper[1]).max() <= 1
    assert 215 < paper[0].min() < 240


def test_a_video_of_high_dynamic_range_is_told_and_tone_mapped(tmp_path):
    luma = np.full((32, 48), 64, np.uint16)  # 10 bits: black, and a code of 0.75
    luma[:, 24:] = 64 + 0.75 * 876
    deep = encoder(tmp_path / "a.mp4", (48, 32), "libx264", "yuv420p10le", crf="2")
    with deep as (stream, put):
        context = stream.codec_context
        context.color_primaries, context.color_trc = 9, 18  # BT.2020, HLG
        context.colorspace, context.color_range = 9, 1
        for _ in range(2):
            image = av.VideoFrame(48, 32, "yuv420p10le")
            for plane, values in zip(image.planes, (luma, 512, 512), strict=True):
                rows = np.frombuffer(memoryview(plane), np.uint16)
                rows = rows.reshape(plane.height, -1)
                rows[:, : plane.width] = values
            put(image)
    _, decoded = next(iter(video.read_video(tmp_path / "a.mp4")))
    code = np.uint16([round(0.75 * 65535)] * 3)
    paper = high_dynamic_range.tone_mapped(code, "HLG")
    assert np.abs(decoded[16, 40].astype(int) - paper).max() <= 1
    assert decoded[16, 8].max() <= 1
    source_images = footage.from_video(tmp_path / "a.mp4", tmp_path / "out")
    assert "high dynamic range (HLG), tone-mapped" in source_images.notes[-1]
    video.write_video(tmp_path / "b.mp4", make_frames())
    assert video.transfer_of(tmp_path / "b.mp4") is None


def test_what_is_no_video_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="no such video"):
        list(video.read_video(tmp_path / "a.mp4"))
    (tmp_path / "b.mp4").write_bytes(b"hello")
    with pytest.raises(CaptureError, match=r"b\.mp4: not a readable video"):
        list(video.read_video(tmp_path / "b.mp4"))
    video.write_video(tmp_path / "c.mp4", make_frames())
    data = (tmp_path / "c.mp4").read_bytes()
    (tmp_path / "c.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(CaptureError, match=r"c\.mp4: "):
        list(video.read_video(tmp_path / "c.mp4"))
    with av.open(str(tmp_path / "d.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=16_000)
        silence = av.AudioFrame.from_ndarray(
            np.zeros((1, 1024), np.float32), "fltp", "mono"
        )
        silence.sample_rate = 16_000
        container.mux(stream.encode(silence))
        container.mux(stream.encode())
    with pytest.raises(CaptureError, match="holds no video"):
        list(video.read_video(tmp_path / "d.mp4"))


def write(path, shapes, count=30, **options):
    """A file with a stream of noise for each (width, height); options of the muxer."""
    rng = np.random.default_rng(0)
    with av.open(str(path), "w", options=options) as container:
        streams = []
        for width, height in shapes:
            stream = container.add_stream("h264", rate=10, options={"crf": "10"})
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            streams.append(stream)
        for _ in range(count):
            for stream in streams:
                shape = (stream.height, stream.width, 3)
                noise = rng.integers(0, 256, shape, np.uint8)
                image = av.VideoFrame.from_ndarray(noise, format="rgb24")
                container.mux(stream.encode(image))
        for stream in streams:
            container.mux(stream.encode())


@pytest.mark.parametrize("ending", ["mp4", "mkv"])
def test_a_file_cut_short_says_how_much_of_it_was_read(ending, tmp_path):
    path = tmp_path / f"a.{ending}"
    write(path, [(64, 48)], movflags="faststart" if ending == "mp4" else "")
    whole = footage.from_video(path, tmp_path / "whole", 5)
    assert not any("cut short" in note for note in whole.notes)
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    part = footage.from_video(path, tmp_path / "part", 5)
    (note,) = [note for note in part.notes if "cut short" in note]
    count = int(note.split(": ")[1].split(" of ")[0])
    assert 12 < count < 20
    assert "of 30 frames" in note
    assert f"of {count} frames selected" in part.notes[0]


def test_damaged_frames_are_left_out_with_a_note_and_refused_by_default(tmp_path):
    path = tmp_path / "a.mp4"
    write(path, [(64, 48)], movflags="faststart")
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    data[start + len(data[start:]) // 2 :] = b"\xff" * len(
        data[start + len(data[start:]) // 2 :]
    )
    path.write_bytes(data)
    source_images = footage.from_video(path, tmp_path / "out", 5)
    assert any("cut short or broken" in note for note in source_images.notes)
    with pytest.raises(CaptureError, match="not a readable video"):
        list(video.read_video(path))


def test_the_largest_of_several_videos_is_read(tmp_path):
    write(tmp_path / "a.mkv", [(32, 16), (64, 48)], 5)
    shapes = {frame.shape for _, frame in video.read_video(tmp_path / "a.mkv")}
    assert shapes == {(48, 64, 3)}
    source_images = footage.from_video(tmp_path / "a.mkv", tmp_path / "out", 3)
    assert any("1 other video streams" in note for note in source_images.notes)


def test_a_cover_is_no_video(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        first = container.add_stream("mjpeg", rate=10)
        first.width, first.height, first.pix_fmt = 128, 96, "yuvj420p"
        first.disposition = first.disposition.attached_pic
        second = container.add_stream("h264", rate=10)
        second.width, second.height, second.pix_fmt = 64, 48, "yuv420p"
        for number in range(5):
            for stream in (first, second)[number > 0 :]:
                shape = (stream.height, stream.width, 3)
                frame = av.VideoFrame.from_ndarray(np.zeros(shape, np.uint8), "rgb24")
                container.mux(stream.encode(frame))
        for stream in (first, second):
            container.mux(stream.encode())
    assert len(list(video.read_video(path))) == 5


def test_a_cover_stored_as_an_ordinary_stream_is_no_video(tmp_path):
    """Larger than the video, and first in the file."""
    video.write_video(tmp_path / "a.mp4", make_frames(6), 10)
    with (
        av.open(str(tmp_path / "a.mp4")) as source,
        av.open(str(tmp_path / "b.mkv"), "w") as target,
    ):
        cover = target.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 96, 64, "yuvj420p"
        copied = target.add_stream_from_template(source.streams.video[0])
        pixels = np.zeros((64, 96, 3), np.uint8)
        target.mux(cover.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        target.mux(cover.encode())
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = copied
                target.mux(packet)
    shown = list(video.read_video(tmp_path / "b.mkv"))
    assert len(shown) == 6
    assert shown[0][1].shape == (32, 46, 3)


def test_pixels_are_made_square(tmp_path):
    path = tmp_path / "a.mp4"
    with encoder(path, (32, 48)) as (stream, put):
        stream.sample_aspect_ratio = 2
        for _ in range(3):
            put(av.VideoFrame.from_ndarray(np.zeros((48, 32, 3), np.uint8), "rgb24"))
    assert next(video.read_video(path))[1].shape == (48, 64, 3)
    assert next(video.read_video(path, gray=True))[1].shape == (48, 64)
    assert "pixels of shape 2, made square" in video.notes_of(path, 3, 0.2)


def coded(path, size, **params):
    """Three frames of raw H.264, which begins anew wherever it is cut."""
    options = {"x264-params": ":".join(f"{k}={v}" for k, v in params.items())}
    with encoder(path, size, **options) as (_, put):
        for frame in make_frames(3, size[::-1]):
            put(av.VideoFrame.from_ndarray(frame, "rgb24"))
    return path.read_bytes()


def test_a_size_that_changes_within_a_video_is_refused(tmp_path):
    parts = [coded(tmp_path / "a.h264", size) for size in ((64, 48), (32, 32))]
    path = tmp_path / "both.h264"
    path.write_bytes(b"".join(parts))
    with pytest.raises(CaptureError, match=r"changes from 64x48 to 32x32 .* frame 3"):
        list(video.read_video(path))


@pytest.mark.parametrize("interlaced", [0, 1])
def test_interlaced_video_is_said(interlaced, tmp_path):
    path = tmp_path / "a.h264"
    coded(path, (64, 48), interlaced=interlaced)
    notes = " ".join(video.notes_of(path, 3, 0.2))
    assert ("interlaced: lines of two times" in notes) == bool(interlaced)
