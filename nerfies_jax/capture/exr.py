"""OpenEXR images: linear color, alpha and depth as floats."""

import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

from nerfies_jax.capture import decoder, safe_files
from nerfies_jax.capture.errors import CaptureError
from nerfies_jax.capture.json_files import AnyPath, replaced_file

SECONDS_PER_NUMBER = 1e-6  # decoding time with a slow codec on a slow machine
_TYPES = (np.float16, np.float32, np.uint32)


class ExrImage(NamedTuple):
    """Channels of an EXR image. NaN and infinity are replaced by 0."""

    color: np.ndarray | None  # [height, width, 3] float32, linear light
    alpha: np.ndarray | None  # [height, width] float32
    depth: np.ndarray | None  # [height, width] float32, channel Z
    extra: dict[str, np.ndarray]  # other channels [height, width], float32 or uint32
    finite: np.ndarray  # [height, width] bool: all channels were finite
    color_finite: np.ndarray  # [height, width] bool: color and alpha were finite
    origin: tuple[int, int]  # x, y of the first pixel in the display window
    display_size: tuple[int, int]  # width, height of the display window


def read_exr(path: AnyPath) -> ExrImage:
    """Read the data window of the first part of an EXR file.

    A luminance channel Y is returned as gray color if there are no RGB channels.

    Args:
      path: The file.

    Returns:
      The channels.

    Raises:
      CaptureError: If the file cannot be read.
    """
    path = existing(path)
    with decoder.session() as child:
        about, _ = _decode(child, path, True)
        about, channels = _decode(child, path, False, about["numbers"])
    return _crop(channels, tuple(about["origin"]), tuple(about["display_size"]))


def read_size(path: AnyPath) -> tuple[int, int]:
    """Read the size of the display window from the header.

    Args:
      path: The file.

    Returns:
      Width and height in pixels.

    Raises:
      CaptureError: If the file cannot be read.
    """
    path = existing(path)
    with decoder.session() as child:
        return tuple(_decode(child, path, True).about["display_size"])


def in_display_window(path: AnyPath, image: ExrImage) -> ExrImage:
    """Crop or pad an image to the display window, which cameras refer to.

    Renderers store a crop or overscan as a data window of another size. Pixels without
    data become 0 and count as not finite. Pixels outside of the display window are
    dropped.

    Args:
      path: The file, for error messages.
      image: The channels of the data window.

    Returns:
      The channels of the display window.

    Raises:
      CaptureError: If the windows do not overlap, so no pixel of the image is stored.
    """
    (left, top), (width, height) = image.origin, image.display_size
    data_height, data_width = image.finite.shape
    if (left, top, data_width, data_height) == (0, 0, width, height):
        return image
    rows = slice(max(top, 0), min(top + data_height, height))
    columns = slice(max(left, 0), min(left + data_width, width))
    if rows.start >= rows.stop or columns.start >= columns.stop:
        raise CaptureError(
            f"{path}: its data window of {data_width}x{data_height} pixels at "
            f"({left}, {top}) lies outside its display window of {width}x{height}; "
            "render it again"
        )

    def fit(array):
        if array is None:
            return None
        window = np.zeros((height, width, *array.shape[2:]), array.dtype)
        window[rows, columns] = array[
            rows.start - top : rows.stop - top,
            columns.start - left : columns.stop - left,
        ]
        return window

    return ExrImage(
        color=fit(image.color),
        alpha=fit(image.alpha),
        depth=fit(image.depth),
        extra={name: fit(array) for name, array in image.extra.items()},
        finite=fit(image.finite),
        color_finite=fit(image.color_finite),
        origin=(0, 0),
        display_size=image.display_size,
    )


def existing(path: AnyPath) -> pathlib.Path:
    """Check that an image exists and may be read.

    Args:
      path: The image.

    Returns:
      The same path.

    Raises:
      CaptureError: If it is missing or leads outside of the capture.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise CaptureError(f"{path}: no such image; restore it or drop its frame")
    return safe_files.check(path)


def _decode(child, path, header_only, numbers=0):
    try:
        return child.request(
            "exr",
            cpu_seconds=numbers * SECONDS_PER_NUMBER,
            memory_bytes=12 * numbers,
            path=str(path.absolute()),
            header_only=header_only,
        )
    except decoder.DecoderError as error:
        if error.has_advice:
            raise CaptureError(f"{path}: {error}") from None
        raise CaptureError(
            f"{path}: not a readable EXR ({error}); it may be truncated, so write it "
            "again"
        ) from None


def _crop(channels, origin, display_size):
    channels = {
        name: array if array.dtype == np.uint32 else array.astype(np.float32)
        for name, array in channels.items()
    }
    is_finite = {name: np.isfinite(array) for name, array in channels.items()}
    finite = np.logical_and.reduce([*is_finite.values()])
    # The depth of a background is often infinite, but its color is finite.
    color_masks = [is_finite[name] for name in "RGBYA" if name in is_finite]
    color_finite = np.logical_and.reduce(color_masks) if color_masks else finite
    channels = {
        name: np.where(np.isfinite(array), array, array.dtype.type(0))
        for name, array in channels.items()
    }
    color = None
    if all(name in channels for name in "RGB"):
        color = np.stack([channels.pop(name) for name in "RGB"], axis=-1)
    elif "Y" in channels:
        color = np.repeat(channels.pop("Y")[..., None], 3, axis=-1)
    alpha, depth = channels.pop("A", None), channels.pop("Z", None)
    return ExrImage(
        color, alpha, depth, channels, finite, color_finite, origin, display_size
    )


def write_exr(
    path: AnyPath,
    color: np.ndarray | None = None,
    alpha: np.ndarray | None = None,
    depth: np.ndarray | None = None,
    extra: Mapping[str, np.ndarray] | None = None,
    half: bool = False,
    header: Mapping[str, Any] | None = None,
):
    """Write an EXR file, losslessly (ZIP) and atomically.

    Args:
      path: The file.
      color: Linear light, [height, width, 3].
      alpha: Opacity, [height, width].
      depth: z-depth, [height, width], as channel Z.
      extra: Other channels [height, width] by name.
      half: True to store color and alpha in 16 bits. Depth and extra channels keep 32,
        since 11 bits of precision would quantize depth visibly.
      header: Further attributes: numbers, strings, and float32 vectors and matrices.

    Raises:
      ValueError: If a value exceeds the range of its type, or shapes differ.
    """
    path = pathlib.Path(path)
    channels: dict[str, np.ndarray] = {}
    if color is not None:
        channels |= dict(zip("RGB", np.moveaxis(color, -1, 0), strict=True))
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
    attributes = {
        **(header or {}),
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    # `File` needs contiguous arrays. It also replaces the values of its arguments by
    # its own objects, so both dicts are copies.
    contiguous = {name: np.ascontiguousarray(array) for name, array in channels.items()}
    try:
        with (
            replaced_file(path) as partial,
            OpenEXR.File(attributes, contiguous) as file,
        ):
            file.write(str(partial))
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise CaptureError(
            f"{path}: cannot be written ({reason}); choose another place"
        ) from None
