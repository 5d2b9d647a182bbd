"""COLMAP models, read by pycolmap in a child process with limits."""

import pathlib

from nerfies_jax.capture import colmap_tables, decoder, extras, safe_files
from nerfies_jax.capture.capture import CaptureError

FILES = tuple(
    path
    for name in colmap_tables.TEXT_FILES
    for path in (name, name.replace(".txt", ".bin"))
)
# Bytes in memory per byte on disk, for pycolmap's objects and their Python copies.
MEMORY_RATIO = 40
# Lower bound of the reading speed. A slow machine reads text at 4 MB per second.
BYTES_PER_SECOND = 1e6


def tables(folder: pathlib.Path) -> decoder.Answer:
    """Read a sparse model, binary or text, in the decoder process.

    Args:
      folder: Folder of the model.

    Returns:
      The result of `colmap_tables.read`.

    Raises:
      CaptureError: If the model cannot be read.
      MissingExtra: If pycolmap is not installed.
    """
    extras.check("pycolmap", "sfm")
    size = 0
    for name in FILES:
        if (folder / name).is_file():
            size += safe_files.check(folder / name).stat().st_size
    try:
        with decoder.session() as child:
            return child.request(
                "colmap",
                cpu_seconds=size / BYTES_PER_SECOND,
                memory_bytes=MEMORY_RATIO * size,
                folder=str(folder.absolute()),
            )
    except decoder.DecoderError as error:
        raise CaptureError(
            f"{folder}: not a readable COLMAP model ({error}); export it again"
        ) from None
