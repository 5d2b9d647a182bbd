"""OpenEXR pictures: linear colour, alpha and depth as floats."""

import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.json_files import AnyPath, replaced_file

MAX_FLOATS = (
    512_000_000  # over all channels; a 4K frame with 20 channels has 166 million
)
_TYPES = (np.float16, np.float32, np.uint32)


class ExrPicture(NamedTuple):
    """One EXR, every array [height, width] first. NaN and infinity are zeroed."""

    colour: np.ndarray | None  # [height, width, 3] float32, linear light
    alpha: np.ndarray | None  # [height, width] float32
    depth: np.ndarray | None  # [height, width] float32, channel Z
    extra: dict[str, np.ndarray]  # every other channel, float32 or uint32
    finite: np.ndarray  # [height, width] bool: no channel was NaN or infinite here
    origin: tuple[int, int]  # x, y of the first pixel in the display window


def read_exr(path: AnyPath) -> ExrPicture:
    """The first part's data window. A luminance channel Y alone becomes grey colour."""
    path = _existing(path)
    try:
        origin, (width, height) = _window(path)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            # Copied: the arrays belong to the file, and `channels()` is empty once it
            # closes.
            channels = {k: np.array(v.pixels) for k, v in file.channels().items()}
    except CaptureError:
        raise
    except Exception as error:  # OpenEXR raises RuntimeError, ValueError and its own
        raise _unreadable(path, error) from None
    if not channels or any(c.shape != (height, width) for c in channels.values()):
        raise CaptureError(f"{path}: its pixels do not fill its window; write it again")
    return _picture(channels, origin)


def read_size(path: AnyPath) -> tuple[int, int]:
    """Width and height in pixels, from the header alone."""
    path = _existing(path)
    try:
        return _window(path)[1]
    except CaptureError:
        raise
    except Exception as error:  # as above
        raise _unreadable(path, error) from None


def _existing(path):
    path = pathlib.Path(path)
    if not path.is_file():
        raise CaptureError(f"{path}: no such picture; restore it or drop its frame")
    return path


def _unreadable(path, error):
    reason = " ".join(str(error).split()) or type(error).__name__
    return CaptureError(
        f"{path}: not a readable EXR ({reason}); it may be cut short, so write it again"
    )


def _window(path):
    """Origin and size of the data window, bounded before any pixel is decoded."""
    with OpenEXR.File(str(path), header_only=True) as file:
        header = file.header()  # it empties when the file closes
        (left, top), (right, bottom) = (
            np.asarray(x, int) for x in header["dataWindow"]
        )
        channels = header["channels"]
        width, height = int(right - left + 1), int(bottom - top + 1)
        if not 0 < width * height * len(channels) <= MAX_FLOATS:
            raise CaptureError(
                f"{path}: {width}x{height} pixels of {len(channels)} channels, more "
                f"than {MAX_FLOATS} numbers; crop it or keep fewer channels"
            )
        if any(
            channel.xSampling != 1 or channel.ySampling != 1 for channel in channels
        ):
            raise CaptureError(
                f"{path}: channels of different resolution (luminance-chroma); save it "
                "as RGB"
            )
    return (int(left), int(top)), (width, height)


def _picture(channels, origin):
    channels = {
        name: array if array.dtype == np.uint32 else array.astype(np.float32)
        for name, array in channels.items()
    }
    finite = np.logical_and.reduce([np.isfinite(array) for array in channels.values()])
    channels = {
        name: np.where(np.isfinite(array), array, array.dtype.type(0))
        for name, array in channels.items()
    }
    colour = None
    if all(name in channels for name in "RGB"):
        colour = np.stack([channels.pop(name) for name in "RGB"], axis=-1)
    elif "Y" in channels:
        colour = np.repeat(channels.pop("Y")[..., None], 3, axis=-1)
    alpha, depth = channels.pop("A", None), channels.pop("Z", None)
    return ExrPicture(colour, alpha, depth, channels, finite, origin)


def write_exr(
    path: AnyPath,
    colour: np.ndarray | None = None,
    alpha: np.ndarray | None = None,
    depth: np.ndarray | None = None,
    extra: Mapping[str, np.ndarray] | None = None,
    half: bool = False,
    header: Mapping[str, Any] | None = None,
):
    """Lossless (ZIP), atomically; `colour` [height, width, 3] is linear light.

    `header` are more attributes: numbers, texts, vectors and matrices of float32.

    `half` stores colour and alpha in 16 bits; depth and the extra channels keep 32,
    because a half has 11 bits and a depth map would fall into steps.
    """
    path = pathlib.Path(path)
    channels = {}
    if colour is not None:
        channels |= dict(zip("RGB", np.moveaxis(colour, -1, 0), strict=True))
    if alpha is not None:
        channels["A"] = alpha
    kind = np.float16 if half else np.float32
    largest = np.finfo(kind).max
    for name, array in channels.items():
        bright = np.isfinite(array) & (np.abs(array) > largest)
        if bright.any():
            raise ValueError(
                f"{path}: channel {name} reaches {np.abs(array[bright]).max():.3g}, "
                f"above the {largest:.5g} of a half float; write it with half=False"
            )
    channels = {name: array.astype(kind) for name, array in channels.items()}
    if depth is not None:
        channels["Z"] = depth.astype(np.float32)
    for name, array in (extra or {}).items():
        channels[name] = array if array.dtype in _TYPES else array.astype(np.float32)
    shapes = {array.shape for array in channels.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or 0 in next(iter(shapes)):
        raise ValueError(
            f"{path}: channels of shapes {sorted(shapes)}; expected at least one, all "
            "[height, width]"
        )
    every = {
        **(header or {}),
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    # `File` turns the arrays of the dicts it is given into its own objects; these are
    # ours alone. It also wants them contiguous.
    contiguous = {name: np.ascontiguousarray(array) for name, array in channels.items()}
    try:
        with replaced_file(path) as partial, OpenEXR.File(every, contiguous) as file:
            file.write(str(partial))
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise CaptureError(
            f"{path}: cannot be written ({reason}); choose another place"
        ) from None
