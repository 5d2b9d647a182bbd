"""Photographs of phones and cameras, turned upright.

HEIC and images of more than `images.LARGE_PIXELS` pixels are decoded in a child process
with limits. `decoder_child` imports this module, so it imports no JAX.
"""

import contextlib
import importlib
import math
import numbers
import pathlib
import warnings
from typing import NamedTuple

import numpy as np
import PIL.Image
import PIL.ImageOps

from nerfies_jax.capture import images, safe_files
from nerfies_jax.capture.errors import CaptureError

HEIC = (".heic", ".heif")  # read if pillow-heif is installed
FULL_FRAME_MM = 36.0  # the longer side that the 35 mm equivalent refers to
_MAKE, _MODEL = 0x010F, 0x0110
_ORIENTATION, _EXIF, _FOCAL_35MM = 0x0112, 0x8769, 0xA405


class Unreadable(CaptureError):
    """The file is not an image despite its name, or is damaged."""


class TooLarge(CaptureError):
    """The image has more pixels than the limit, or a damaged header."""


class Header(NamedTuple):
    """Properties of a photograph from its header."""

    size: tuple[int, int]  # width and height, upright
    focal: float | None  # focal length over the longest side, if the file states it
    camera: str | None = None  # maker and model of the camera, if the file states them


def heic_is_read() -> bool:
    """Test if HEIC can be read, and register its package with Pillow."""
    try:
        importlib.import_module("pillow_heif").register_heif_opener()
    except ImportError:
        return False
    return True


def read_header(path: pathlib.Path) -> Header:
    """Read the header of a photograph.

    Args:
      path: The file.

    Returns:
      The header.

    Raises:
      Unreadable: If it is not an image.
      TooLarge: If it has more than `images.MAX_PIXELS` pixels.
    """
    if path.suffix.lower() not in HEIC:
        return decode_header(path)
    about = _decode_apart(path, (0, 0), header_only=True).about
    return Header(tuple(about["size"]), about["focal"], about["camera"])


def read_upright(path: pathlib.Path) -> np.ndarray:
    """Read a photograph, rotated upright, with transparent parts over black.

    Args:
      path: The file.

    Returns:
      uint8 sRGB [height, width, 3].

    Raises:
      Unreadable: If it is damaged.
      CaptureError: If its values have an unknown range.
    """
    size = read_header(path).size
    if path.suffix.lower() not in HEIC and size[0] * size[1] <= images.LARGE_PIXELS:
        return decode_upright(path)
    return _decode_apart(path, size, header_only=False).arrays["pixels"]


def _decode_apart(path, size, header_only):
    """Decode a file in a child process, with errors of this module."""
    path = safe_files.check(path)
    answer = images.decode_apart(
        "photograph", path, size, _unreadable, header_only=header_only
    )
    if "refused" in answer.about:
        kind = TooLarge if answer.about["refused"] == TooLarge.__name__ else Unreadable
        raise kind(answer.about["message"])
    return answer


def decode_header(path: pathlib.Path) -> Header:
    """Read the header of a photograph in this process, for `read_header`.

    Args:
      path: The file.

    Returns:
      The header.

    Raises:
      Unreadable: As for `read_header`.
      TooLarge: As for `read_header`.
    """
    with _open(path) as image:
        tags = image.getexif()
        is_rotated = tags.get(_ORIENTATION, 1) in (5, 6, 7, 8)  # by 90 degrees
        size = image.size[::-1] if is_rotated else image.size
        value = tags.get_ifd(_EXIF).get(_FOCAL_35MM)
        names = [tags.get(tag) for tag in (_MAKE, _MODEL)]
    focal = None
    # The value may be anything: several numbers, text, or 0 for unknown.
    if isinstance(value, numbers.Real) and 0 < float(value) < math.inf:
        focal = float(value) / FULL_FRAME_MM
    # Old cameras fill the text with spaces or zeros.
    texts = [name.strip(" \0") for name in names if isinstance(name, str)]
    return Header(size, focal, " ".join(filter(None, texts)) or None)


def decode_upright(path: pathlib.Path) -> np.ndarray:
    """Decode a photograph in this process, for `read_upright`.

    Args:
      path: The file.

    Returns:
      uint8 sRGB, [height, width, 3].

    Raises:
      CaptureError: As for `read_upright`.
    """
    with _open(path) as image:
        image = PIL.ImageOps.exif_transpose(image)
        if image.mode == "F":
            raise CaptureError(
                f"{path}: an image of 32-bit floats, whose range is unknown; save it "
                "with 8 or 16 bits"
            )
        if image.mode.startswith("I"):  # 16-bit gray
            values = np.asarray(image)
            if not 0 <= values.min() <= values.max() <= 65535:
                raise CaptureError(
                    f"{path}: 32-bit gray up to {values.max()}, whose range is "
                    "unknown; save it with 8 or 16 bits"
                )
            values = values.astype(np.uint32) // 257
            return np.repeat(values.astype(np.uint8)[..., None], 3, axis=2)
        if image.has_transparency_data:  # RGB alone would show the removed parts
            image = image.convert("RGBA")
            black = PIL.Image.new("RGBA", image.size, (0, 0, 0, 255))
            image = PIL.Image.alpha_composite(black, image)
        return np.asarray(image.convert("RGB"))


@contextlib.contextmanager
def _open(path):
    """Open an image as stored, and raise a one-line error for any defect."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", PIL.Image.DecompressionBombWarning)
            with PIL.Image.open(path) as image:
                if image.width * image.height > images.MAX_PIXELS:
                    raise PIL.Image.DecompressionBombError
                yield image
    except CaptureError:
        raise
    except (PIL.Image.DecompressionBombWarning, PIL.Image.DecompressionBombError):
        raise _too_large(path) from None
    # Pillow's parsers may raise anything.
    except Exception as error:
        raise _unreadable(path, error) from None


def _too_large(path):
    return TooLarge(
        f"{path}: more than {images.MAX_PIXELS:,} pixels; make the image smaller first"
    )


def _unreadable(path, error):
    reason = " ".join(str(error).split()) or type(error).__name__
    return Unreadable(
        f"{path}: not a readable image ({reason}); copy it again or remove it"
    )
