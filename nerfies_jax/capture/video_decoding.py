"""Decoding of video with PyAV. It runs in `decoder_child`, so it imports no JAX."""

import contextlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from nerfies_jax.capture import extras
from nerfies_jax.capture.errors import FileError
from nerfies_jax.capture.high_dynamic_range import CODES, TRANSFERS, tone_mapped

MAX_PIXELS = 64_000_000  # of a frame
HD_LINES = 720  # from this height on, players assume BT.709 by default
_UNSPECIFIED = 2  # FFmpeg's number of an unspecified color space
COVERS = ("mjpeg", "png", "bmp", "gif", "webp", "tiff")  # image codecs
SLACK = 3  # frames by which the duration in the header may be wrong

Reply = tuple[dict[str, Any], dict[str, np.ndarray]]


def frames(
    path: str, most: int, rows: list[int] | None, gray: bool, damaged: str
) -> Iterator[Reply]:
    """Decode frames, for `video.read_video`.

    Args:
      path: The video.
      most: As for `video.read_video`.
      rows: As for `video.read_video`.
      gray: As for `video.read_video`.
      damaged: As for `video.read_video`.

    Yields:
      Seconds and pixels of a frame, or empty dicts for a frame that is skipped.

    Raises:
      FileError: If the video cannot be used, with the remedy but without the path.
    """
    last = math.inf if rows is None else max(rows, default=-1)
    requested_rows = None if rows is None else set(rows)
    count, size = 0, None
    with _opened(path) as container:
        stream = _main_stream(container)
        _check_size(stream.width, stream.height)
        stream.thread_type = "AUTO"
        aspect = stream.sample_aspect_ratio
        for number, frame in enumerate(_decode(container, stream, damaged)):
            size = size or (frame.width, frame.height)
            if (frame.width, frame.height) != size:
                raise FileError(
                    f"the size changes from {size[0]}x{size[1]} to "
                    f"{frame.width}x{frame.height} pixels at frame {number}; cut the "
                    "video there"
                )
            if requested_rows is not None and number not in requested_rows:
                yield {}, {}
                continue
            if count >= most:
                return
            count += 1
            square_frame = _square(frame, aspect)
            pixels = (
                square_frame.to_ndarray(format="gray")
                if gray
                else _pixels(square_frame)
            )
            upright = _upright(pixels, frame)
            yield {"seconds": float(frame.time or 0.0)}, {"pixels": upright}
            if number >= last:
                return
    if not count:
        raise FileError("holds no frames; copy or encode it again")


def transfer(path: str) -> Iterator[Reply]:
    """Find the transfer function of an HDR video.

    Args:
      path: The video.

    Yields:
      The transfer function, None for other videos.
    """
    with _opened(path) as container:
        frame = next(container.decode(_main_stream(container)), None)
        name = None if frame is None else TRANSFERS.get(int(frame.color_trc))
        yield {"transfer": name}, {}


def length(path: str) -> Iterator[Reply]:
    """Read the number of frames of a video from its header.

    Args:
      path: The video.

    Yields:
      The number of frames.
    """
    with _opened(path) as container:
        stream = _main_stream(container)
        seconds = (container.duration or 0) / 1e6
        count = stream.frames or round(seconds * float(stream.average_rate or 0))
        yield {"frames": count}, {}


def notes(path: str, count: int, last: float) -> Iterator[Reply]:
    """Describe anything unusual about a video, for `video.notes_of`.

    Args:
      path: The video.
      count: Number of frames that could be read.
      last: Time of the last one in seconds.

    Yields:
      Notes.
    """
    with _opened(path) as container:
        yield {"notes": _notes(container, count, last)}, {}


@contextlib.contextmanager
def _opened(path):
    """Open a video, with FFmpeg's errors reduced to their messages."""
    av = extras.library("av", "video")
    try:
        with av.open(path) as container:
            yield container
    except (av.FFmpegError, OSError) as error:
        raise ValueError(str(error.strerror or error)) from None


def _check_size(width, height):
    if width * height > MAX_PIXELS:
        raise FileError(
            f"{width}x{height} frames, more than {MAX_PIXELS} pixels; encode it smaller"
        )


def _main_stream(container):
    """The largest video stream of a file, which may also hold covers and previews."""
    videos = [
        stream
        for stream in container.streams.video
        if not stream.disposition & stream.disposition.attached_pic
    ]
    # Some programs store covers as ordinary streams.
    videos = [each for each in videos if each.codec.name not in COVERS] or videos
    if not videos:
        raise FileError("holds no video, at most a cover image; pass a video")
    default = [
        stream for stream in videos if stream.disposition.default in stream.disposition
    ]
    return max(default or videos, key=lambda stream: stream.width * stream.height)


def _notes(container, count, last):
    stream = _main_stream(container)
    notes = _shortfall(container, stream, count, last)
    others = len(container.streams.video) - 1
    if others:
        notes += (
            f"{others} other video streams of the file, such as a cover, are not read",
        )
    aspect = stream.sample_aspect_ratio
    if aspect and aspect != 1:
        notes += (f"pixels of shape {aspect}, made square",)
    frame = next(container.decode(stream), None)
    if frame is not None and frame.interlaced_frame:
        notes += (
            "interlaced: lines of two times alternate; deinterlace what moves fast "
            "first (ffmpeg -vf bwdif)",
        )
    return notes


def _shortfall(container, stream, count, last):
    """A note if the video ends before the duration in its header."""
    interval = float(1 / stream.average_rate) if stream.average_rate else 0.0
    slack = SLACK * interval
    if stream.duration is not None and stream.time_base is not None:
        start = float((stream.start_time or 0) * stream.time_base)
        length = float(stream.duration * stream.time_base)
    elif container.duration is not None:  # of sound, too, which may go on longer
        start = (container.start_time or 0) / 1e6
        length = container.duration / 1e6
        slack = max(slack, 0.02 * length)
        if len(container.streams) > 1:
            slack = max(slack, 1.0)
    else:
        return ()
    duration = last - start + interval
    if duration >= length - slack:
        return ()
    frames = stream.frames or (round(length / interval) if interval else 0)
    of = f"{count} of {frames}" if frames > count else f"{count}"
    return (
        f"the file is cut short or broken: {of} frames could be read, {duration:.1f} "
        f"of {length:.1f} s",
    )


def _decode(container, stream, on_damage):
    """Decode frames. Unless damage is refused, skip those that cannot be decoded."""
    damage = extras.library("av", "video").FFmpegError
    if on_damage == "refuse":
        yield from container.decode(stream)
        return
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
            if packet is None:
                return
        except damage:  # the file ends here; flush the decoder
            with contextlib.suppress(damage):
                yield from stream.codec_context.decode(None)
            return
        with contextlib.suppress(damage):
            yield from packet.decode()


def _square(frame, aspect):
    """Resample a frame to square pixels without losing resolution."""
    if not aspect or aspect <= 0 or aspect == 1:
        return frame
    width, height = frame.width, frame.height
    if aspect > 1:
        width = round(width * aspect)
    else:
        height = round(height / aspect)
    _check_size(width, height)
    return frame.reformat(width=width, height=height)


def _pixels(frame):
    """uint8 sRGB [height, width, 3]."""
    transfer = TRANSFERS.get(int(frame.color_trc))
    if transfer is None:
        has_default = frame.colorspace != _UNSPECIFIED or frame.height < HD_LINES
        space = None if has_default else "ITU709"  # FFmpeg would assume BT.601
        return frame.to_ndarray(
            format="rgb24", src_colorspace=space, dst_colorspace=space
        )
    # FFmpeg's white is 255/256 of the largest 16-bit value.
    code = frame.to_ndarray(format="rgb48le").astype(np.uint32) * 257 // 256
    return tone_mapped(np.minimum(code, CODES - 1).astype(np.uint16), transfer)


def _upright(pixels, frame):
    """Rotate and mirror an image by the display matrix of the video, if it has one."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return pixels
    # x' = a x + c y and y' = b x + d y for stored pixel coordinates (x, y)
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[:5].tolist()
    if abs(a) + abs(d) < abs(b) + abs(c):
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return np.ascontiguousarray(pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])
