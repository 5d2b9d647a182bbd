"""Selection and decoding of frames, shared by all readers."""

import math
import pathlib
import re
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from nerfies_jax.capture import (
    decoder,
    frame_memory,
    masks,
    safe_files,
    text_files,
)
from nerfies_jax.capture import images as image_files
from nerfies_jax.capture.capture import CaptureError, blocks, shrink
from nerfies_jax.runtime import earlier_names, events

__getattr__ = earlier_names.attributes(__name__)

MAX_FRAMES = 100_000
MAX_BYTES = 64 * 2**30  # of decoded images
OPAQUE = 128  # smallest alpha of opaque pixels
SUFFIXES = (".png", ".jpg", ".jpeg")  # in lower case; files may use any case
_ENDINGS = ("", *SUFFIXES, *map(str.upper, SUFFIXES))


def natural(name: str) -> tuple:
    """Return a sort key under which frame 9 comes before frame 10.

    Args:
      name: Name of the frame.

    Returns:
      The key.
    """
    parts = re.split(r"(\d+)", name)
    return tuple((0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts)


def choose_source(
    available: Collection[int],
    full_size: tuple[int, int],
    factor: int | None,
    max_side: int | None,
    where: str,
) -> tuple[int, int]:
    """Choose the stored reduction to read, and the further reduction.

    Args:
      available: Folders by reduction (1, 2, 4, ...).
      full_size: Width and height of the full-size images in pixels.
      factor: Requested reduction.
      max_side: Requested longest side in pixels. At most one of the two can be given.
      where: Name of the capture in error messages.

    Returns:
      The stored reduction, and the integer factor to reduce it by. The largest stored
      images if nothing is requested.

    Raises:
      CaptureError: If the request is invalid or cannot be made from the stored
        reductions.
    """
    if factor is not None and max_side is not None:
        raise CaptureError(
            f"{where}: give factor={factor} or max_side={max_side}, not both"
        )
    if max_side is not None:
        if max_side < 1:
            raise CaptureError(
                f"{where}: max_side={max_side}; expected at least 1 pixel"
            )
        side = max(full_size)
        # Of a stored reduction the size may have been rounded up.
        factor = min(
            each * least_factor(math.ceil(side / each), max_side) for each in available
        )
    if factor is None:
        return min(available), 1
    divisors = [source for source in available if factor >= 1 and factor % source == 0]
    if not divisors:
        raise CaptureError(
            f"{where}: images cannot be reduced by factor={factor}; there are "
            f"reductions {sorted(available)}, so use a multiple of one of them"
        )
    return max(divisors), factor // max(divisors)


def least_factor(side: int, max_side: int) -> int:
    """Return the smallest integer reduction to at most a number of pixels.

    Incomplete blocks are cropped, so 427 pixels become 213 by a factor of two.

    Args:
      side: Length of a side in pixels.
      max_side: Largest allowed length in pixels.

    Returns:
      The factor.
    """
    return side // (max_side + 1) + 1


def find_image(folder: pathlib.Path, name: str) -> pathlib.Path | None:
    """Find an image by its name, which may lack its suffix.

    The spelling on disk may differ as described in `text_files.find`.

    Args:
      folder: Folder of the image.
      name: Name or relative path.

    Returns:
      Path of the file, or None.
    """
    return text_files.find(folder, name, _ENDINGS)


def local_name(folder: pathlib.Path, name: str) -> str:
    """Return the name of an image in this folder for a path of another machine.

    Args:
      folder: Folder of the capture.
      name: Name from a file.

    Returns:
      The end of an absolute path, or of one that leads out of the folder, if an image
      of that name is here. Else the name.
    """
    return text_files.find_local(folder, name, _ENDINGS) or name


def moved_note(names: Sequence[str], local: Sequence[str]) -> tuple[str, ...]:
    """Describe the names that `local_name` replaced.

    Args:
      names: Names from a file.
      local: The results of `local_name`.

    Returns:
      A note, or an empty tuple if the names are equal.
    """
    pairs = zip(names, local, strict=True)
    changes = [(name, end) for name, end in pairs if name != end]
    if not changes:
        return ()
    name, end = changes[0]
    return (
        f"{len(changes)} file names are paths in another folder ({name}, ...): read "
        f"from this one ({end}, ...)",
    )


def images_in(
    folder: pathlib.Path, suffixes: Sequence[str] = SUFFIXES
) -> list[pathlib.Path]:
    """List the image files of a folder.

    Hidden files are skipped: macOS writes ._A.JPG next to A.JPG, which is not an image.

    Args:
      folder: The folder.
      suffixes: Suffixes of images in lower case.

    Returns:
      Paths in lexicographic order.
    """
    return sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in suffixes
        and not file.name.startswith(".")
        and file.is_file()
    )


def check_missing(missing: str, where: str) -> None:
    """Check the setting for frames without an image.

    Args:
      missing: The setting.
      where: Name of the capture in error messages.

    Raises:
      CaptureError: If it is neither "refuse" nor "skip".
    """
    if missing not in ("refuse", "skip"):
        raise CaptureError(f'{where}: missing={missing!r}; expected "refuse" or "skip"')


def keep_found(
    paths: Sequence[pathlib.Path | None],
    names: Sequence[str],
    missing: str,
    where: str,
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Select the frames whose file exists.

    Args:
      paths: Path of each frame, None if it was not found.
      names: Names of the frames.
      missing: "refuse" or "skip" frames without a file.
      where: Name of the capture in error messages.

    Returns:
      Rows of the existing files, and a note if others were skipped.

    Raises:
      CaptureError: If a file is missing and `missing` is "refuse", or if all are
        missing.
    """
    check_missing(missing, where)
    rows = np.array([row for row, path in enumerate(paths) if path is not None], int)
    absent = [name for name, path in zip(names, paths, strict=True) if path is None]
    if not absent:
        return rows, ()
    listing = ", ".join(absent[:5]) + (", ..." if len(absent) > 5 else "")
    if missing == "refuse" or not rows.size:
        raise CaptureError(
            f"{where}: {len(absent)} of {len(names)} images are missing ({listing}); "
            'restore them, or leave those frames out with missing="skip"'
        )
    return rows, (
        f"{len(absent)} frames left out, their images are missing: {listing}",
    )


class Frames(NamedTuple):
    """The decoded images of a capture, uint8."""

    images: np.ndarray  # [frames, height, width, 3]
    alpha: np.ndarray | None  # [frames, height, width]; None if no file has it
    # [frames, height, width] bool, False where an EXR has no color; None if all have
    observed: np.ndarray | None
    notes: tuple[str, ...]

    def valid(self) -> np.ndarray | None:
        """Return the observed pixels of a format that marks them with alpha 255.

        Returns:
          Booleans [frames, height, width], None for all.
        """
        if self.alpha is None:
            return self.observed
        opaque = frame_memory.allocate(self.alpha.shape, np.bool_)
        np.equal(self.alpha, 255, out=opaque)
        return opaque if self.observed is None else opaque & self.observed


def allocated(shape: tuple[int, int, int, int], where: str) -> np.ndarray:
    """Allocate the images of a capture, and say so if a file holds them.

    Args:
      shape: Frames, height, width and channels.
      where: Name of the capture in error messages.

    Returns:
      uint8 array of zeros.

    Raises:
      CaptureError: If they need more than `MAX_BYTES` or than the disk has.
    """
    count, height, width, _ = shape
    total = math.prod(shape)
    size = f"{count:,} images of {width}x{height}"
    if total > MAX_BYTES:
        raise CaptureError(
            f"{where}: {size} need {total / 2**30:.0f} GiB, more than "
            f"{MAX_BYTES / 2**30:.0f}; read them smaller with factor= or max_side="
        )
    try:
        images = frame_memory.allocate(shape, np.uint8)
    except OSError as error:
        raise CaptureError(
            f"{where}: {size} need a temporary file ({error}); free space, set "
            "XDG_CACHE_HOME to another disk, or read smaller images with factor= or "
            "max_side="
        ) from error
    if frame_memory.is_mapped(images):
        events.message(
            f"frames are streamed from disk: {size} take {total / 2**30:.1f} GiB, "
            f"more than {frame_memory.MOST_IN_MEMORY / 2**30:.0f} GiB"
        )
    return images


def both(first: np.ndarray | None, second: np.ndarray | None) -> np.ndarray | None:
    """Intersect two masks.

    Args:
      first: A mask, None for all pixels.
      second: A mask of the same shape, None for all pixels.

    Returns:
      Pixels that are in both masks, None for all.
    """
    if first is None or second is None:
        return second if first is None else first
    return first & second


@decoder.session()
def read_frames(
    paths: Sequence[pathlib.Path],
    shrink_by: int = 1,
    background: tuple[float, float, float] | None = None,
    orientation: str = "refuse",
) -> Frames:
    """Read the images of a capture.

    All sizes are checked before the first image is decoded.

    Args:
      paths: Files of equal size.
      shrink_by: Integer reduction.
      background: sRGB color in [0, 1] over which images with alpha are composited, at
        full resolution. None keeps the color as stored.
      orientation: "refuse" images that EXIF rotates, or read them as "stored".

    Returns:
      The images.

    Raises:
      CaptureError: If an image cannot be read, or sizes differ or are out of bounds.
    """
    if len(paths) > MAX_FRAMES:
        raise CaptureError(
            f"{paths[0].parent}: {len(paths)} frames; at most {MAX_FRAMES}"
        )
    width, height = size = image_files.read_header(paths[0]).size
    for path in paths[1:]:
        other = image_files.read_header(path).size
        if other != size:
            raise CaptureError(
                f"{path}: {other[0]}x{other[1]} pixels, but {paths[0].name} has "
                f"{width}x{height}; the frames of a capture share one size"
            )
    width, height = width // shrink_by, height // shrink_by
    if min(width, height) < 1:
        raise CaptureError(
            f"{paths[0]}: {size} pixels cannot be reduced by {shrink_by}; use a "
            "smaller factor"
        )
    colors = allocated((len(paths), height, width, 3), str(paths[0].parent))
    # 255 - alpha: the zeros of opaque images, as of most captures, use no memory until
    # they are written.
    transparencies = frame_memory.allocate((len(paths), height, width), np.uint8)

    def decode(row):
        alpha = is_observed = None
        if paths[row].suffix.lower() == image_files.EXR:
            color, is_observed = image_files.read_light(paths[row])
        else:
            color, alpha = image_files.read_image(paths[row], orientation)
        if alpha is not None and background is not None:
            color = image_files.over(color, alpha, background)
        colors[row] = shrink(color, shrink_by)
        if alpha is not None:
            transparencies[row] = 255 - shrink(alpha[..., None], shrink_by)[..., 0]
        if is_observed is not None:
            is_observed = blocks(is_observed, shrink_by).all((-3, -1))
        return alpha is not None, is_observed

    # Decoding releases the GIL. Four threads read 86 frames of 512x384 in 0.25 s, and
    # one in 0.8 s.
    any_alpha, unknown = False, {}
    stage = events.stage("reading images", len(paths))
    with ThreadPoolExecutor(4) as pool, stage as reading:
        for row, (has_alpha, is_observed) in enumerate(
            pool.map(safe_files.carried(decode), range(len(paths)))
        ):
            any_alpha |= has_alpha
            if is_observed is not None:
                unknown[row] = is_observed
            reading.advance()
    alpha = None
    if any_alpha:
        alpha = np.subtract(255, transparencies, out=transparencies)
        if 0 < (most := int(alpha.max())) < OPAQUE:
            raise CaptureError(
                f"{paths[0].parent}: the alpha of all images is at most {most} of 255, "
                "so no pixel is opaque; save it as 0 and 255, or the images without it"
            )
    if not unknown:
        return Frames(colors, alpha, None, ())
    observed_mask = np.ones(colors.shape[:3], bool)
    for row, is_observed in unknown.items():
        observed_mask[row] = is_observed
    note = (
        f"{len(unknown)} EXR images have pixels outside their data window or not "
        f"finite, {1 - observed_mask.mean():.1%} of all: taken as not observed"
    )
    return Frames(colors, alpha, observed_mask, (note,))


def read_masks(
    paths: Sequence[pathlib.Path | None],
    size: tuple[int, int],
    shrink_by: int,
    black: str,
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Read the masks of all frames.

    Args:
      paths: A file per frame, None for frames without a mask. At least one is a file.
      size: Width and height of the reduced images in pixels.
      shrink_by: Integer reduction of masks that have the size of the stored images.
        Other masks may have any integer multiple of `size`.
      black: Meaning of black pixels, for messages: "not observed" or "moving".

    Returns:
      The share of white in each block, float32 [frames, height, width], 1 for frames
      without a mask; and a note on the encoding of white.

    Raises:
      CaptureError: If a mask has another size, or all masks are black.
    """
    width, height = size
    share = frame_memory.allocate((len(paths), height, width), np.float32)
    share.fill(1)
    files = [path for path in paths if path is not None]
    encoding = masks.find_encoding(files)
    for row, path in enumerate(paths):
        if path is None:
            continue
        mask = masks.read_mask(path, encoding)
        mask_height, mask_width = mask.shape
        # Masks are often stored at full size only, next to smaller images.
        for factor in (shrink_by, max(1, round(mask_width / width))):
            if (mask_width // factor, mask_height // factor) == (width, height):
                break
        else:
            raise CaptureError(
                f"{path}: a mask of {mask_width}x{mask_height} pixels for images of "
                f"{width * shrink_by}x{height * shrink_by}; the sizes must agree, or "
                "that of the mask be an integer multiple"
            )
        share[row] = blocks(mask, factor).mean((-3, -1))
    has_file = np.array([path is not None for path in paths])[:, None, None]
    white = float(share.mean(where=has_file))
    note = masks.describe(files, len(paths), encoding, white, black)
    return share, (note,)
