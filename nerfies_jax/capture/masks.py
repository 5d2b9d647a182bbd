"""Mask images in any encoding, which is determined for a whole set.

A single mask is ambiguous: a file of zeros and ones looks black, and a frame in which
nothing is marked has only one value.
"""

import pathlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import PIL.Image
import PIL.ImageOps

from nerfies_jax.capture import images, safe_files
from nerfies_jax.capture.errors import CaptureError
from nerfies_jax.capture.json_files import AnyPath

ADVICE = "save the masks as 8-bit gray PNG of 0 and 255"
OPAQUE = 128  # smallest alpha of opaque pixels
COLORFUL = 32  # smallest difference of two channels, above the artifacts of JPEG
FEW = 16  # largest number of distinct values of a mask that is not a photograph
MOST_LABELS = 64  # largest number of distinct labels
LOSSY = (".jpg", ".jpeg")


class Encoding(NamedTuple):
    """Encoding of white in a set of mask images."""

    alpha: bool  # True if opaque pixels are white, regardless of their color
    threshold: int  # smallest stored value of white
    text: str  # description


class Stored(NamedTuple):
    """One mask as stored."""

    value: np.ndarray  # [height, width], the largest of the color channels
    alpha: np.ndarray | None  # [height, width] bool
    full: int  # largest value of the file's type
    colorful: bool  # True if it has pixels that are not gray


class _Survey(NamedTuple):
    """Statistics of the values of one mask."""

    path: pathlib.Path
    counts: np.ndarray  # number of pixels of each value
    full: int
    colorful: bool
    has_alpha: bool
    opaque: bool  # True if all pixels are
    cut_out: bool  # True if only alpha can be the mask


def read_mask(
    path: AnyPath, encoding: Encoding | None = None, orientation: str = "refuse"
) -> np.ndarray:
    """Read one mask.

    Args:
      path: An image of any type that `images` reads.
      encoding: Encoding of the set. By default, that of this file alone.
      orientation: "refuse" a mask that EXIF rotates, or rotate it "upright".

    Returns:
      True where the mask is white, bool [height, width].
    """
    path = pathlib.Path(path)
    encoding = encoding or find_encoding([path], orientation)
    pixels = _read(path, orientation)
    if encoding.alpha:
        return pixels.alpha
    return pixels.value >= encoding.threshold


def find_encoding(paths: Sequence[AnyPath], orientation: str = "refuse") -> Encoding:
    """Determine the encoding of white from the values of all masks of a set.

    Args:
      paths: Files of the set, at least one.
      orientation: As in `read_mask`.

    Returns:
      The encoding.

    Raises:
      CaptureError: If the masks are ambiguous, with the name of a file.
    """
    with ThreadPoolExecutor(4) as pool:
        run_survey = safe_files.carried(_survey)
        files = map(pathlib.Path, paths)
        surveys = list(pool.map(lambda file: run_survey(file, orientation), files))
    transparent = [
        survey for survey in surveys if survey.has_alpha and not survey.opaque
    ]
    if transparent:
        return _alpha_encoding(surveys)
    deepest = max(survey.full for survey in surveys)
    other = next((survey for survey in surveys if survey.full != deepest), None)
    if other is not None:
        raise CaptureError(
            f"{other.path}: a mask of {_bits(other.full)} bits among masks of "
            f"{_bits(deepest)}; {ADVICE}"
        )
    return _value_encoding(surveys)


def describe(
    files: Sequence[pathlib.Path],
    frames: int,
    encoding: Encoding,
    white: float,
    black: str,
) -> str:
    """Describe how masks were read, for the notes of a capture.

    Args:
      files: Masks of the set.
      frames: Number of frames that could have one.
      encoding: Their encoding.
      white: Share of white over all of them.
      black: Meaning of black pixels: "not observed" or "moving".

    Returns:
      The text.

    Raises:
      CaptureError: If all pixels of all masks are black.
    """
    folder = files[0].parent
    if white == 0:
        raise CaptureError(
            f"{folder}: every pixel of all {len(files)} masks is black, and black is "
            f"{black} ({encoding.text}); invert the masks if they are the other way "
            "around, else leave them out"
        )
    count = f"{len(files)}" if len(files) == frames else f"{len(files)} of {frames}"
    share_text = f"{1 - white:.1%} of their pixels are black: {black}"
    if white == 1:
        share_text = f"no pixel is black, so none is {black}"
    return f"{count} masks of {encoding.text}; {share_text}"


def _bits(full):
    return 8 if full == 255 else 16


def _alpha_encoding(surveys):
    for survey in surveys:
        if not survey.has_alpha:
            raise CaptureError(
                f"{survey.path}: a mask without alpha channel among masks with one; "
                f"{ADVICE}"
            )
        if not survey.cut_out:
            raise CaptureError(
                f"{survey.path}: a mask with an alpha channel and black in its color, "
                f"and either could be the mask; {ADVICE}"
            )
    return Encoding(True, 0, "alpha, opaque is taken as white")


def _value_encoding(surveys):
    counts = np.sum([survey.counts for survey in surveys], axis=0)
    values = np.flatnonzero(counts)
    least, most = int(values[0]), int(values[-1])
    colorful = any(survey.colorful for survey in surveys)
    # 16-bit files often hold values of 8 bits.
    scale = 255 if most <= 255 else surveys[0].full
    half = (scale + 1) // 2
    first = surveys[0].path
    listing = ", ".join(map(str, values[:5])) + (", ..." if len(values) > 5 else "")
    if colorful and least > 0:
        raise CaptureError(
            f"{first}: a mask in color without any black, so the marked pixels are "
            f"unknown; {ADVICE}"
        )
    if len(values) == 1 and (most in (0, 1) or most >= half):
        return Encoding(False, 1, f"the one value {most}")
    if len(values) == 2 and least == 0:
        text = f"values 0 and {most}"
        return Encoding(
            False, most, text if most == surveys[0].full else f"{text} (white)"
        )
    is_few = len(values) <= FEW
    labels = least == 0 and len(values) <= MOST_LABELS
    if labels and (colorful or most < half or (is_few and most < 0.9 * scale)):
        return Encoding(False, 1, f"labels {listing}; all but 0 are taken as white")
    for survey in surveys:
        present = np.flatnonzero(survey.counts)
        lossy = survey.path.suffix.lower() in LOSSY
        if len(present) == 2 and present[0] == 0 and present[1] < half and not lossy:
            raise CaptureError(
                f"{survey.path}: a mask of 0 and {present[1]} among masks up to "
                f"{most}; {ADVICE}"
            )
    low = values[(values > 0) & (values < FEW)]
    void = is_few and counts[low].sum() > 1e-3 * counts.sum()
    if colorful or void or not least < half <= most:
        raise CaptureError(
            f"{first}: masks of values {listing}, up to {most}, that are neither black "
            f"and white nor 0 and labels; {ADVICE}"
        )
    return Encoding(False, half, f"gray values, white from {half} on")


def _survey(path, orientation):
    pixels = _read(path, orientation)
    counts = np.bincount(pixels.value.ravel(), minlength=pixels.full + 1)
    alpha = pixels.alpha
    return _Survey(
        path=path,
        counts=counts,
        full=pixels.full,
        colorful=pixels.colorful,
        has_alpha=alpha is not None,
        opaque=alpha is None or bool(alpha.all()),
        cut_out=alpha is not None and _is_cut_out(pixels.value, alpha),
    )


def _is_cut_out(value, alpha):
    """Test if the color of opaque pixels has no black, or is a photograph."""
    inside = value[alpha] if alpha.any() else value
    if not alpha.any() and value.min() == value.max():
        return True  # nothing is marked
    return bool(inside.min() > 0) or len(np.unique(inside)) > FEW


def _read(path, orientation):
    header = images.read_header(path)
    if header.mode == "EXR":
        return _from_channels(images.read_pixels(path), None)
    if header.orientation not in (0, 1) and orientation != "upright":
        raise CaptureError(
            f"{path}: the EXIF orientation of this mask is {header.orientation}; "
            "rotate its pixels and remove the tag"
        )
    if header.size[0] * header.size[1] <= images.LARGE_PIXELS:
        return decode(path)
    answer = images.decode_apart("mask", path, header.size, images.unreadable)
    value, alpha = answer.arrays["value"], answer.arrays.get("alpha")
    return Stored(value, alpha, answer.about["full"], answer.about["colorful"])


def decode(path: AnyPath) -> Stored:
    """Decode a mask with Pillow, upright.

    Args:
      path: The file, which may not be an EXR.

    Returns:
      The mask as stored.

    Raises:
      CaptureError: If it is not an image that may be a mask.
    """
    with images.opened(path) as image:
        return _decode(path, PIL.ImageOps.exif_transpose(image))


def _decode(path, image):
    if image.mode.startswith("I"):
        value = np.asarray(image)
        if not 0 <= value.min() <= value.max() <= 65535:
            raise CaptureError(
                f"{path}: a mask of values up to {value.max()}, more than 16 bits; "
                f"{ADVICE}"
            )
        return Stored(value.astype(np.uint16), None, 65535, False)
    if image.has_transparency_data:
        pixels = np.asarray(image.convert("RGBA"))
        return _from_channels(pixels[..., :3], pixels[..., 3] >= OPAQUE)
    if image.mode not in ("1", "L", "P", "RGB"):
        raise CaptureError(
            f"{path}: a mask of color mode {image.mode}; expected gray or RGB: {ADVICE}"
        )
    image = image.convert("RGB" if image.mode == "P" else image.mode)
    pixels = np.asarray(image)
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.uint8) * 255
    return _from_channels(pixels if pixels.ndim == 3 else pixels[..., None], None)


def _from_channels(pixels, alpha):
    value = pixels.max(-1)
    spread = value - pixels.min(-1)
    colorful = float((spread > COLORFUL).mean()) > 1e-3
    return Stored(value, alpha, 255, colorful)
