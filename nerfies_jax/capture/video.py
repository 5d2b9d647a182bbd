"""Reading and writing of video with PyAV, which comes with the extra `video`."""

import contextlib
import itertools
import math
import pathlib
from collections.abc import Collection, Iterable, Iterator
from fractions import Fraction

import numpy as np

from nerfies_jax.capture import extras, safe_files
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.high_dynamic_range import (
    CODES,
    TRANSFERS,
    Transfer,
    tone_mapped,
)
from nerfies_jax.capture.images import MAX_PIXELS
from nerfies_jax.capture.json_files import AnyPath, replaced_file

HD_LINES = 720  # from here on players take BT.709 where a film does not say
_UNSAID = 2  # ffmpeg's number of a color space that is not told
SLACK = 3  # frames by which the stated length of a whole film may be wrong
LEAST_RATE = 0.001  # frames per second; rates are fractions of up to 1001 seconds


def library():
    """Import PyAV.

    Returns:
      The module.

    Raises:
      MissingExtra: If it is not installed.
    """
    return extras.library("av", "video")


def write_video(
    path: AnyPath,
    frames: Iterable[np.ndarray],
    frames_per_second: float | int = 30,
    quality: int = 18,
):
    """Write frames as H.264 video, atomically.

    An odd width or height grows by one repeated line, since the chroma of `yuv420p`,
    which every player supports, is subsampled by two.

    Args:
      path: The file, .mp4, .mov or .mkv.
      frames: uint8 sRGB frames, [height, width, 3].
      frames_per_second: Frame rate.
      quality: Constant rate factor of x264: 0 is lossless, 18 visually lossless, 28
        coarse.

    Raises:
      CaptureError: If the file cannot be written.
      ValueError: If there are no frames or the rate is too low.
    """
    path = pathlib.Path(path)
    if path.suffix not in (".mp4", ".mov", ".mkv"):
        raise CaptureError(f"{path}: cannot be written; end its name in .mp4")
    av = library()
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{path}: no frames to write; pass at least one")
    if not LEAST_RATE <= frames_per_second < math.inf:
        raise ValueError(
            f"{path}: frames_per_second={frames_per_second}; expected at least "
            f"{LEAST_RATE}"
        )
    try:
        with replaced_file(path) as partial:
            _encode(av, partial, path, first, frames, frames_per_second, quality)
    except av.FFmpegError as error:
        raise CaptureError(
            f"{path}: cannot be written ({error.strerror}); choose another place"
        ) from None


def _encode(av, partial, path, first, frames, frames_per_second, quality):
    height, width = first.shape[:2]
    with av.open(str(partial), "w") as container:
        rate = Fraction(frames_per_second).limit_denominator(1001)
        # With its macroblock tree x264 reads what it has not written: equal frames made
        # another film in every process, and of 14 of them COLMAP once found a path
        # that was off by 22% of its extent, and not by 3%.
        options = {"crf": str(quality), "x264-params": "mbtree=0"}
        stream = container.add_stream("h264", rate=rate, options=options)
        stream.width, stream.height = width + width % 2, height + height % 2
        stream.pix_fmt = "yuv420p"
        # Without these tags a player guesses the matrix from the height of the picture
        # and shifts the colors of small films; BT.709 is what sRGB displays assume.
        stream.codec_context.color_primaries = 1
        stream.codec_context.color_trc = 13
        stream.codec_context.colorspace = 1
        stream.codec_context.color_range = 1
        for number, frame in enumerate(itertools.chain([first], frames)):
            if frame.shape != first.shape or frame.dtype != np.uint8:
                raise ValueError(
                    f"{path}: frame {number} is {frame.dtype} of shape {frame.shape}; "
                    f"expected uint8 of shape {first.shape}, as the first"
                )
            padded = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), "edge")
            picture = av.VideoFrame.from_ndarray(padded, format="rgb24").reformat(
                format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG"
            )
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def transfer_of(path: AnyPath) -> Transfer | None:
    """Return the transfer function of an HDR video.

    Args:
      path: The video.

    Returns:
      The transfer function, None for other videos and for files that cannot be read
      (`read_video` reports the reason).
    """
    av = library()
    try:
        with av.open(str(path.absolute())) as container:
            frame = next(container.decode(_main_stream(container, path)), None)
            return None if frame is None else TRANSFERS.get(int(frame.color_trc))
    except (av.FFmpegError, OSError, CaptureError):
        return None


def _main_stream(container, path):
    """The largest video of a file: covers and previews are streams of it, too."""
    videos = [
        stream
        for stream in container.streams.video
        if not stream.disposition & stream.disposition.attached_pic
    ]
    if not videos:
        raise CaptureError(
            f"{path}: holds no pictures that move, at most a cover; pass a film"
        )
    default = [
        stream for stream in videos if stream.disposition.default in stream.disposition
    ]
    return max(default or videos, key=lambda stream: stream.width * stream.height)


def notes_of(path: pathlib.Path, count: int, last: float) -> tuple[str, ...]:
    """Say what is unusual about a video that was read to its end.

    Args:
      path: The video.
      count: Frames that could be read.
      last: Time of the last one in seconds.

    Returns:
      Notes: that the file is cut short or damaged, which stream of several was read,
      that its pixels are not square, that it is interlaced.
    """
    with library().open(str(path.absolute())) as container:
        stream = _main_stream(container, path)
        notes = _shortfall(container, stream, count, last)
        others = len(container.streams.video) - 1
        if others:
            notes += (
                f"{others} other video streams of the file, such as a cover, are not "
                "read",
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
    """A note where the video ends before the time that its file states."""
    interval = float(1 / stream.average_rate) if stream.average_rate else 0.0
    slack = SLACK * interval
    if stream.duration is not None and stream.time_base is not None:
        start = float((stream.start_time or 0) * stream.time_base)
        length = float(stream.duration * stream.time_base)
    elif container.duration is not None:  # of sound, too, which may go on longer
        start = (container.start_time or 0) / 1e6
        length = container.duration / 1e6
        slack = max(slack, 1.0, 0.02 * length)
    else:
        return ()
    read = last - start + interval
    if read >= length - slack:
        return ()
    frames = stream.frames or (round(length / interval) if interval else 0)
    of = f"{count} of {frames}" if frames > count else f"{count}"
    return (
        f"the file is cut short or broken: {of} frames could be read, {read:.1f} of "
        f"{length:.1f} s",
    )


def _decoded(av, container, stream, damaged):
    """Decode frames, and skip those that cannot be decoded if damage is allowed."""
    if damaged == "refuse":
        yield from container.decode(stream)
        return
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
            if packet is None:
                return
        except av.FFmpegError:  # the file ends here; what the decoder holds is whole
            with contextlib.suppress(av.FFmpegError):
                yield from stream.codec_context.decode(None)
            return
        with contextlib.suppress(av.FFmpegError):
            yield from packet.decode()


def _square(frame, aspect):
    """The frame with square pixels, none of them lost."""
    if not aspect or aspect == 1:
        return frame
    if aspect > 1:
        return frame.reformat(width=round(frame.width * aspect), height=frame.height)
    return frame.reformat(width=frame.width, height=round(frame.height / aspect))


def _pixels(frame):
    """uint8 sRGB [height, width, 3]."""
    transfer = TRANSFERS.get(int(frame.color_trc))
    if transfer is None:
        told = frame.colorspace != _UNSAID or frame.height < HD_LINES
        space = None if told else "ITU709"  # ffmpeg would take BT.601
        return frame.to_ndarray(
            format="rgb24", src_colorspace=space, dst_colorspace=space
        )
    # ffmpeg's white is 255/256 of what 16 bits hold.
    code = frame.to_ndarray(format="rgb48le").astype(np.uint32) * 257 // 256
    return tone_mapped(np.minimum(code, CODES - 1).astype(np.uint16), transfer)


def _upright(pixels, frame):
    """The picture turned and mirrored as the matrix of the film says, if it has one."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return pixels
    # x' = a x + c y and y' = b x + d y, of pixels (x, y) as they are stored
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[:5].tolist()
    if abs(a) + abs(d) < abs(b) + abs(c):
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return np.ascontiguousarray(pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


def read_video(
    path: AnyPath,
    stride: int = 1,
    most: int = 2**31,
    rows: Collection[int] | None = None,
    gray: bool = False,
    damaged: str = "refuse",
) -> Iterator[tuple[float, np.ndarray]]:
    """Read the frames of a video, upright and with square pixels.

    Times are the video's own, so a variable frame rate is preserved. A phone's rotation
    tag is applied, and HDR is tone-mapped. Frames that cannot be decoded, such as the
    end of an interrupted download, are reported by `notes_of`.

    Args:
      path: The video.
      stride: Read every `stride`-th frame.
      most: Largest number of frames to read.
      rows: Numbers of the only frames to return. Nothing after the last of them is
        decoded. None for all.
      gray: True for coded luma, uint8 [height, width]. A frame of 3840x2160 HLG takes
        0.16 s of processor time, compared with 1.8 s in color.
      damaged: "refuse" or "skip" frames that cannot be decoded.

    Yields:
      Seconds, and uint8 sRGB [height, width, 3].

    Raises:
      CaptureError: If the video cannot be read.
    """
    if damaged not in ("refuse", "skip"):
        raise ValueError(f'{path}: damaged={damaged!r}; expected "refuse" or "skip"')
    path = pathlib.Path(path)
    last = math.inf if rows is None else max(rows, default=-1)
    if not path.is_file():
        raise CaptureError(f"{path}: no such film; check the path")
    safe_files.check(path)
    shown, av = 0, library()
    try:
        with av.open(str(path.absolute())) as container:
            stream = _main_stream(container, path)
            if stream.width * stream.height > MAX_PIXELS:
                raise CaptureError(
                    f"{path}: {stream.width}x{stream.height} frames, more than "
                    f"{MAX_PIXELS} pixels; encode it smaller"
                )
            stream.thread_type, size = "AUTO", None
            aspect = stream.sample_aspect_ratio
            decoded = _decoded(av, container, stream, damaged)
            for number, frame in enumerate(decoded):
                size = size or (frame.width, frame.height)
                if (frame.width, frame.height) != size:
                    raise CaptureError(
                        f"{path}: the size changes from {size[0]}x{size[1]} to "
                        f"{frame.width}x{frame.height} pixels at frame {number}; cut "
                        "the film there"
                    )
                if number % stride or not (rows is None or number in rows):
                    continue
                if shown >= most:
                    return
                shown += 1
                shown_as = _square(frame, aspect)
                if gray:
                    pixels = shown_as.to_ndarray(format="gray")
                else:
                    pixels = _pixels(shown_as)
                yield float(frame.time or 0.0), _upright(pixels, frame)
                if number >= last:
                    return
    except (av.FFmpegError, OSError) as error:
        reason = " ".join(str(error.strerror or error).split())
        raise CaptureError(
            f"{path}: not a readable film ({reason}); copy or encode it again"
        ) from None
    if not shown:
        raise CaptureError(f"{path}: holds no frames; copy or encode it again")
