"""COLMAP models as pycolmap reads them, and text models that it does not."""

import contextlib
import pathlib
import tempfile
from typing import Any

from nerfies_jax.capture import safe_files, text_files
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.colmap_library import library

# pycolmap reads these if there are no binary files of that name.
TEXT_FILES = ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt")
FILES = (*TEXT_FILES, *(name.replace(".txt", ".bin") for name in TEXT_FILES))
_BROKEN = (ValueError, RuntimeError, IndexError, KeyError, MemoryError, OSError)


def reconstruction(folder: pathlib.Path) -> Any:
    """Read a sparse model, binary or text.

    In text files, image names may have spaces, and the encoding may be any Unicode
    encoding with or without a byte order mark.

    Args:
      folder: Folder of the model.

    Returns:
      The pycolmap.Reconstruction.

    Raises:
      CaptureError: If the model cannot be read.
    """
    pycolmap = library()
    for name in FILES:
        if (folder / name).is_file():
            safe_files.check(folder / name)
    try:
        with contextlib.ExitStack() as stack:
            source = _as_utf8(folder, stack)
            model = pycolmap.Reconstruction(str(source))
            if not (folder / "images.bin").is_file():
                _restore_names(model, source / "images.txt")
            return model
    except _BROKEN as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CaptureError(
            f"{folder}: not a readable COLMAP model ({reason}); export it again"
        ) from None


def _as_utf8(folder, stack):
    """The folder, or a temporary copy of its text files in UTF-8."""
    files = [folder / name for name in TEXT_FILES if (folder / name).is_file()]
    if all(_is_plain(file) for file in files) or (folder / "images.bin").is_file():
        return folder
    copy = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
    for file in files:
        (copy / file.name).write_bytes(text_files.utf8(file.read_bytes()))
    return copy


def _is_plain(file):
    with file.open("rb") as stream:
        return text_files.encoding_of(stream.read(4)) == "utf-8"


def _restore_names(model, file):
    """Give images their whole names: pycolmap ends them at the first space."""
    lines = file.read_text(encoding="utf-8", errors="surrogateescape").split("\n")
    lines = [line.strip() for line in lines]
    lines = [line for line in lines if not line.startswith("#")]
    for line in _pose_lines(lines):
        parts = line.split(maxsplit=9)
        if len(parts) == 10 and " " in parts[9] and int(parts[0]) in model.images:
            model.images[int(parts[0])].name = parts[9]


def _pose_lines(lines):
    """Every other line: each image has a line of its observations, maybe empty."""
    rows = iter(lines)
    for line in rows:
        if line:  # an empty line before the next image is none of its observations
            yield line
            next(rows, None)
