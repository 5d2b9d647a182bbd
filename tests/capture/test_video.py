"""Film: round trips, odd sizes, times, and broken files."""

import av
import numpy as np
import pytest

from nerfies_jax.capture import video
from nerfies_jax.capture.capture import CaptureError


def film(count=8, size=(31, 45)):
    y, x = np.mgrid[: size[0], : size[1]]
    frames = [np.stack([x * 5, y * 8, x * 0 + 25 * k], -1) for k in range(count)]
    return [np.clip(frame, 0, 255).astype(np.uint8) for frame in frames]


def test_colours_and_times_survive_odd_sizes(tmp_path):
    frames = film()
    video.write_video(tmp_path / "a.mp4", iter(frames), 12.5, quality=2)
    decoded = list(video.read_video(tmp_path / "a.mp4"))
    assert len(decoded) == 8
    assert decoded[0][1].shape == (32, 46, 3)  # padded to even
    for number, (seconds, frame) in enumerate(decoded):
        assert seconds == pytest.approx(number / 12.5, abs=1e-4)
        error = np.abs(frame[:31, :45].astype(int) - frames[number])
        # Chroma is halved and everything quantised: 2 levels on smooth pictures.
        assert error.mean() < 3
        np.testing.assert_allclose(frame[31], frame[30], atol=12)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_the_file_says_which_colours_it_holds(tmp_path):
    video.write_video(tmp_path / "a.mp4", film())
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0].codec_context
        assert (stream.color_primaries, stream.colorspace, stream.color_range) == (
            1,
            1,
            1,
        )
        assert stream.pix_fmt == "yuv420p"


def test_every_other_frame_and_at_most_so_many(tmp_path):
    video.write_video(tmp_path / "a.mp4", film(), 10)
    times = [seconds for seconds, _ in video.read_video(tmp_path / "a.mp4", stride=3)]
    assert times == pytest.approx([0, 0.3, 0.6], abs=1e-4)
    assert len(list(video.read_video(tmp_path / "a.mp4", most=2))) == 2


@pytest.mark.parametrize(
    ("turn", "expected", "mark"),
    [(90, (46, 32), (-4, 4)), (180, (32, 46), (-4, -4)), (-90, (46, 32), (4, -4))],
)
def test_a_phones_rotation_is_carried_out(tmp_path, turn, expected, mark):
    frame = np.zeros((32, 46, 3), np.uint8)
    frame[:8, :8] = 255  # a mark in the top left corner of what is stored
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("h264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 46, 32, "yuv420p"
        if not hasattr(stream, "set_display_rotation"):
            pytest.skip("this PyAV cannot write the tag")
        stream.set_display_rotation(turn)  # degrees against the clock
        for _ in range(3):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    _, decoded = next(iter(video.read_video(tmp_path / "a.mp4")))
    assert decoded.shape[:2] == expected
    assert decoded[mark].min() > 200
    assert decoded[-mark[0], mark[1]].max() < 60


def test_what_is_no_film_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="no such film"):
        list(video.read_video(tmp_path / "a.mp4"))
    (tmp_path / "b.mp4").write_bytes(b"hello")
    with pytest.raises(CaptureError, match=r"b\.mp4: not a readable film"):
        list(video.read_video(tmp_path / "b.mp4"))
    video.write_video(tmp_path / "c.mp4", film())
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
    with pytest.raises(CaptureError, match="holds no pictures"):
        list(video.read_video(tmp_path / "d.mp4"))
