"""Reading and writing of video with PyAV (extra `video`)."""

import contextlib
import itertools
import math
import pathlib
from collections.abc import Collection, Iterable, Iterator
from fractions import Fraction

import numpy as np

from nerfies_jax.capture import decoder, extras, safe_files
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.high_dynamic_range import Transfer
from nerfies_jax.capture.json_files import AnyPath, replaced_file

# Limits for decoding one frame. A frame of 3840x2160 in HDR takes 2 s.
CPU_SECONDS, MEMORY_BYTES = 15.0, 4 * 2**30
# Frames per second. Rates are stored as fractions with denominators up to 1001.
LEAST_RATE = 0.001


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

    An odd width or height is padded by repeating the last column or row, since the
    chroma of `yuv420p`, which all players support, is subsampled by two.

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
        # x264 reads uninitialized memory in its macroblock tree. With it, equal frames
        # gave different videos in different processes, and COLMAP's camera path from 14
        # such frames once had an error of 22 % of its extent instead of 3 %.
        options = {"crf": str(quality), "x264-params": "mbtree=0"}
        stream = container.add_stream("h264", rate=rate, options=options)
        stream.width, stream.height = width + width % 2, height + height % 2
        stream.pix_fmt = "yuv420p"
        # Without these tags a player guesses the color matrix from the height of the
        # image and shifts the colors of small videos. sRGB displays assume BT.709.
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
            even_frame = np.pad(
                frame, ((0, height % 2), (0, width % 2), (0, 0)), "edge"
            )
            video_frame = av.VideoFrame.from_ndarray(
                even_frame, format="rgb24"
            ).reformat(
                format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG"
            )
            container.mux(stream.encode(video_frame))
        container.mux(stream.encode())


def transfer_of(path: pathlib.Path) -> Transfer | None:
    """Return the transfer function of an HDR video.

    Args:
      path: The video.

    Returns:
      The transfer function, None for other videos and for files that cannot be read
      (`read_video` reports the reason).
    """
    try:
        return _request(path, "video_transfer").about["transfer"]
    except CaptureError:
        return None


def notes_of(path: pathlib.Path, count: int, last: float) -> tuple[str, ...]:
    """Describe anything unusual about a video that was read to its end.

    Args:
      path: The video.
      count: Number of frames that could be read.
      last: Time of the last one in seconds.

    Returns:
      Notes on truncation, other video streams, pixels that are not square, and
      interlacing.

    Raises:
      CaptureError: If the video cannot be read.
    """
    answer = _request(path, "video_notes", count=count, last=last)
    return tuple(answer.about["notes"])


def stated_frames(path: pathlib.Path) -> int:
    """Read the number of frames from the header of a video.

    Args:
      path: The video.

    Returns:
      The number of frames, by default duration times frame rate. It may be wrong.

    Raises:
      CaptureError: If the video cannot be read.
    """
    return _request(path, "video_length").about["frames"]


def _request(path, operation, **arguments):
    extras.check("av", "video")
    file = str(safe_files.check(path).absolute())
    try:
        with decoder.session() as child:
            return child.request(
                operation, CPU_SECONDS, MEMORY_BYTES, path=file, **arguments
            )
    except decoder.DecoderError as error:
        raise _unreadable(path, error) from None


def _unreadable(path, error):
    if error.has_advice:
        return CaptureError(f"{path}: {error}")
    return CaptureError(
        f"{path}: not a readable video ({error}); copy or encode it again"
    )


def read_video(
    path: AnyPath,
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
      most: Largest number of frames to read.
      rows: Numbers of the frames to return, None for all. Nothing after the last of
        them is decoded.
      gray: True for the encoded luma, uint8 [height, width]. A frame of 3840x2160 HLG
        takes 0.16 s of processor time, compared with 1.8 s in color.
      damaged: "refuse" or "skip" frames that cannot be decoded.

    Yields:
      Seconds, and uint8 sRGB [height, width, 3].

    Raises:
      CaptureError: If the video cannot be read.
    """
    if damaged not in ("refuse", "skip"):
        raise ValueError(f'{path}: damaged={damaged!r}; expected "refuse" or "skip"')
    path = pathlib.Path(path)
    if not path.is_file():
        raise CaptureError(f"{path}: no such video; check the path")
    safe_files.check(path)
    extras.check("av", "video")
    with decoder.streaming() as child:
        answers = child.stream(
            "video",
            CPU_SECONDS,
            MEMORY_BYTES,
            path=str(path.absolute()),
            most=int(most),
            rows=None if rows is None else sorted(map(int, rows)),
            gray=gray,
            damaged=damaged,
        )
        with contextlib.closing(answers):
            try:
                for about, arrays in answers:
                    if arrays:
                        yield about["seconds"], arrays["pixels"]
            except decoder.DecoderError as error:
                raise _unreadable(path, error) from None
