"""Image files: PNG and JPEG with scikit-image and imageio, EXR with OpenEXR.

Sizes in headers are checked before anything is decoded. Colors are 8-bit sRGB on disk
and in memory. Linear light from EXR is converted to sRGB.
"""

import contextlib
import pathlib
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import imageio.v3
import numpy as np
import PIL.Image
import skimage.io

from nerfies_jax.capture import decoder, exr, safe_files
from nerfies_jax.capture.errors import CaptureError
from nerfies_jax.capture.json_files import AnyPath, replaced_file
from nerfies_jax.capture.srgb import linear_from_srgb as linear_from_srgb
from nerfies_jax.capture.srgb import srgb_from_linear as srgb_from_linear

# An 8K video frame has 33 million pixels. Pillow only warns above 89 million.
MAX_PIXELS = 64_000_000
LARGE_PIXELS = 16_000_000  # larger images are decoded in a child process
SECONDS_PER_PIXEL, BYTES_PER_PIXEL = 1e-6, 24  # upper bounds for decoding
EXR, TIFF = ".exr", (".tif", ".tiff")
_ORIENTATION = 0x0112  # EXIF tag; 1 is upright, 0 unknown
_PILLOW_ERRORS = (Exception,)  # Pillow's parsers may raise anything


class Header(NamedTuple):
    """Properties of an image from its header."""

    size: tuple[int, int]  # width, height as stored
    mode: str  # Pillow's name: RGB, RGBA, L, LA, P, I;16, ...; or EXR
    orientation: int  # of EXIF, by default 1


def read_header(path: AnyPath) -> Header:
    """Read size and kind of a PNG, JPEG or EXR.

    Args:
      path: The file.

    Returns:
      The header.

    Raises:
      CaptureError: If it cannot be read or exceeds `MAX_PIXELS`.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() == EXR:
        return _check(path, Header(exr.read_size(path), "EXR", 1))
    exr.existing(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", PIL.Image.DecompressionBombWarning)
            with PIL.Image.open(path) as image:
                header = Header(image.size, image.mode, _orientation(image))
    except (PIL.Image.DecompressionBombWarning, PIL.Image.DecompressionBombError):
        raise CaptureError(
            f"{path}: more than {MAX_PIXELS} pixels; make the image smaller first"
        ) from None
    except _PILLOW_ERRORS as error:
        raise unreadable(path, error) from None
    return _check(path, header)


def _check(path, header):
    width, height = header.size
    if width * height > MAX_PIXELS:
        raise CaptureError(
            f"{path}: {width}x{height} pixels, more than {MAX_PIXELS}; make the image "
            "smaller first"
        )
    return header


def _orientation(image):
    """The EXIF orientation. For a PNG, `getexif` would decode the whole image."""
    if image.format != "PNG":
        return image.getexif().get(_ORIENTATION, 1)
    tags = PIL.Image.Exif()
    tags.load(image.info.get("exif", b""))
    return tags.get(_ORIENTATION, 1)


def read_pixels(path: AnyPath, orientation: str = "refuse") -> np.ndarray:
    """Read an image as uint8.

    16-bit gray is rounded to 8 bits, and 16-bit color is truncated to 8 bits. Linear
    light of an EXR is converted to sRGB, with values above 1 clipped.

    Args:
      path: The file.
      orientation: "refuse" an image that viewers rotate (EXIF), or read its pixels as
        "stored", since COLMAP's cameras refer to stored pixels.

    Returns:
      uint8 [height, width, 1 to 4]: gray, gray and alpha, RGB or RGBA.

    Raises:
      CaptureError: If it cannot be read or is refused.
    """
    path = pathlib.Path(path)
    header = read_header(path)
    if header.mode == "EXR":
        return read_light(path)[0]
    if header.orientation not in (0, 1) and orientation != "stored":
        raise CaptureError(
            f"{path}: its EXIF orientation is {header.orientation}, so viewers rotate "
            "it, but cameras may refer to the stored pixels; rotate the pixels and "
            "remove the tag"
        )
    if header.size[0] * header.size[1] > LARGE_PIXELS:
        pixels = decode_apart("image", path, header.size, unreadable).arrays["pixels"]
    else:
        pixels = decode(path, header)
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.uint8) * 255
    elif pixels.dtype == np.uint16:
        pixels = ((pixels.astype(np.uint32) * 255 + 32767) // 65535).astype(np.uint8)
    pixels = pixels if pixels.ndim == 3 else pixels[..., None]
    if pixels.dtype != np.uint8 or pixels.shape[1::-1] != header.size:
        raise CaptureError(
            f"{path}: decoded to {pixels.dtype} of shape {pixels.shape}; save it as an "
            "8-bit RGB PNG"
        )
    return pixels


def decode(path: AnyPath, header: Header | None = None) -> np.ndarray:
    """Decode an image with Pillow, for `read_pixels`.

    Args:
      path: The file, which may not be an EXR.
      header: Its header, from `read_header`, if already read.

    Returns:
      The pixels as decoded.

    Raises:
      CaptureError: If it cannot be decoded.
    """
    path = pathlib.Path(path)
    header = header or read_header(path)
    try:
        plain = header.mode in {"RGB", "RGBA", "L", "1", "I;16", "I;16B"}
        if plain and path.suffix.lower() in TIFF:
            # skimage.io.imread needs a further package for compressed files.
            with PIL.Image.open(path) as image:
                pixels = np.asarray(image)
            if header.mode.startswith("I;16"):
                pixels = pixels.astype(np.uint16)
        elif plain:
            pixels = skimage.io.imread(path)
        elif header.mode in {"LA", "P", "PA"}:
            # skimage.io.imread transposes LA (it takes [height, width, 2] for channels
            # first) and ignores the transparency of a palette.
            with PIL.Image.open(path) as image:
                opaque = header.mode == "P" and "transparency" not in image.info
                pixels = np.asarray(image.convert("RGB" if opaque else "RGBA"))
        else:
            raise CaptureError(
                f"{path}: color mode {header.mode}; expected gray, RGB or RGBA, so "
                "save it as an RGB PNG"
            )
    except CaptureError:
        raise
    except _PILLOW_ERRORS as error:
        raise unreadable(path, error) from None
    return pixels


def decode_apart(
    operation: str,
    path: pathlib.Path,
    size: tuple[int, int],
    unreadable: Callable[[pathlib.Path, Exception], CaptureError],
    **arguments: Any,
) -> decoder.Answer:
    """Decode a large image in a child process with limits.

    Args:
      operation: Operation of `decoder_child` that takes a path.
      path: The file.
      size: Width and height in pixels, which the limits depend on.
      unreadable: Makes the error for a file that cannot be decoded.
      **arguments: Further arguments of the operation.

    Returns:
      The answer of the child.

    Raises:
      CaptureError: If it cannot be decoded.
    """
    count = size[0] * size[1]
    try:
        with decoder.session() as child:
            return child.request(
                operation,
                cpu_seconds=count * SECONDS_PER_PIXEL,
                memory_bytes=BYTES_PER_PIXEL * count,
                path=str(path.absolute()),
                **arguments,
            )
    except decoder.DecoderError as error:
        if error.has_advice:  # the message is that of a CaptureError, with the path
            raise CaptureError(str(error)) from None
        raise unreadable(path, error) from None


@contextlib.contextmanager
def opened(path: AnyPath) -> Iterator[PIL.Image.Image]:
    """Open an image with Pillow.

    Args:
      path: The file.

    Yields:
      The image.

    Raises:
      CaptureError: If it cannot be decoded.
    """
    safe_files.check(path)
    try:
        with PIL.Image.open(path) as image:
            yield image
    except CaptureError:
        raise
    except _PILLOW_ERRORS as error:
        raise unreadable(path, error) from None


def read_numbers(path: AnyPath) -> np.ndarray:
    """Read the first channel of an image as stored, for depth and other values.

    Args:
      path: The file.

    Returns:
      Values [height, width], with all bits for gray of 16 bits and more, else as in
      `read_pixels`.
    """
    path = pathlib.Path(path)
    if not read_header(path).mode.startswith("I"):
        return read_pixels(path, "stored")[..., 0]
    with opened(path) as image:
        return np.asarray(image)


def read_light(path: AnyPath) -> tuple[np.ndarray, np.ndarray | None]:
    """Read the colors of an EXR and a mask of the pixels that have one.

    Args:
      path: The file.

    Returns:
      uint8 sRGB [height, width, 3] of the display window, and booleans [height, width]
      that are False for pixels that are not stored, NaN or infinite. These are black.
      None instead of booleans that are all True.

    Raises:
      CaptureError: If it cannot be read, has no color, or is partly transparent.
    """
    content = exr.read_exr(path)
    if content.color is None:
        raise CaptureError(f"{path}: no color channels; save it with R, G and B")
    transparent = content.alpha is not None and content.color_finite & (
        content.alpha < 1
    )
    if np.any(transparent):
        raise CaptureError(
            f"{path}: it has transparent pixels, and its colors may be premultiplied "
            "by alpha or not; composite it over its background first, or save it as a "
            "PNG"
        )
    content = exr.in_display_window(path, content)
    assert content.color is not None
    color = np.round(srgb_from_linear(content.color) * 255).astype(np.uint8)
    finite = content.color_finite
    if finite.all():
        return color, None
    color[~finite] = 0
    return color, finite


def read_image(
    path: AnyPath, orientation: str = "refuse"
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read an image as color and alpha.

    Args:
      path: The file.
      orientation: "refuse" an image that viewers rotate (EXIF), or read it as "stored".

    Returns:
      uint8 color [height, width, 3] and uint8 alpha [height, width], None without
      alpha.
    """
    pixels = read_pixels(path, orientation)
    channels = pixels.shape[2]
    alpha = pixels[..., -1] if channels in (2, 4) else None
    color = pixels[..., :3] if channels >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    return np.ascontiguousarray(color), alpha


def over(color: np.ndarray, alpha: np.ndarray, background: tuple) -> np.ndarray:
    """Composite color with straight alpha over one color, in sRGB as stored.

    Args:
      color: uint8 color, [height, width, 3].
      alpha: uint8 alpha, [height, width].
      background: sRGB color in [0, 1].

    Returns:
      uint8 color, [height, width, 3].
    """
    opacity = alpha[..., None].astype(np.float32) / 255
    behind = np.asarray(background, np.float32) * 255
    return np.round(color * opacity + behind * (1 - opacity)).astype(np.uint8)


def write_png(path: AnyPath, pixels: np.ndarray):
    """Write a PNG file atomically.

    Args:
      path: The file.
      pixels: uint8 or uint16 [height, width] or [height, width, 1 to 4], or a boolean
        mask.

    Raises:
      ValueError: If the type is another.
      CaptureError: If the file cannot be written.
    """
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.uint8) * 255
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(
            f"{path}: PNG holds uint8 or uint16, got {pixels.dtype}; convert first, or "
            "write an EXR"
        )
    # Encoded in memory, since on a full disk imageio would fail again in its finalizer,
    # and Python would print that error with a traceback.
    png_bytes = imageio.v3.imwrite("<bytes>", pixels, extension=".png")
    with replaced_file(path) as partial:
        partial.write_bytes(png_bytes)


def unreadable(path: AnyPath, error: Exception) -> CaptureError:
    """Make the error of an image that cannot be decoded.

    Args:
      path: The image.
      error: The reason.

    Returns:
      The error, with the remedy.
    """
    reason = " ".join(str(error).split()) or type(error).__name__
    return CaptureError(
        f"{path}: not a readable image ({reason}); it may be truncated, so copy or "
        "export it again"
    )
