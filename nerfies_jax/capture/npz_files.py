"""NumPy arrays from untrusted files, which may be damaged or truncated.

Sizes in headers are checked against the actual number of bytes and bounded before
anything is allocated, and Python objects are never loaded.
"""

import contextlib
import io
import math
import os
import pathlib
import zipfile
import zlib
from collections.abc import Collection, Iterator

import numpy as np

from nerfies_jax.capture import safe_files
from nerfies_jax.capture.safe_files import AnyPath

MAX_BYTES = 16 * 2**30  # of all arrays of an archive, or of one .npy
MAX_MEMBERS = 10_000
MAX_AXES = 16
MAX_HEADER = 2**16  # bytes of the header of an array
# Largest compression ratio of an archive, for arrays of more than `FREE_BYTES`. Deflate
# can reach 1032, with zeros only. Masks that are mostly empty reach 300, but are rarely
# that large.
MAX_EXPANSION = 100
FREE_BYTES = 256 * 2**20
_CHUNK = 2**24  # bytes to read at a time

# Errors of zipfile, zlib and NumPy for damaged bytes, besides OSError. RuntimeError is
# raised for unknown compression or a password, AttributeError for a .npy.
DAMAGED = (
    *(ValueError, KeyError, TypeError, AttributeError, IndexError, EOFError),
    *(zipfile.BadZipFile, zlib.error, RuntimeError, OverflowError, MemoryError),
)


class Archive:
    """The arrays of an open .npz file, within a budget of bytes."""

    def __init__(self, archive: zipfile.ZipFile, file_bytes: int, most: int):
        self._archive = archive
        members = archive.infolist()
        if len(members) > MAX_MEMBERS:
            raise ValueError(f"{len(members)} arrays; at most {MAX_MEMBERS} are read")
        self._members: dict[str, zipfile.ZipInfo] = {}
        for member in members:
            name = member.filename.removesuffix(".npy")
            # NumPy writes no others, and their decompression cannot be bounded.
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{name} has a compression that NumPy does not use")
            if name in self._members:
                raise ValueError(f"{name} is stored twice")
            self._members[name] = member
        total = sum(member.file_size for member in members)
        if total > most:
            raise ValueError(f"it unpacks to {total} bytes; at most {most} are read")
        if total > FREE_BYTES and total > MAX_EXPANSION * file_bytes:
            raise ValueError(
                f"{file_bytes} bytes unpack to {total}, more than {MAX_EXPANSION} "
                "times as many; if that is intended, save it with numpy.savez, which "
                "does not compress"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arrays."""
        return tuple(self._members)

    def read(self, name: str) -> np.ndarray:
        """Unpack one array.

        Args:
          name: Name of the array.

        Returns:
          The array.

        Raises:
          ValueError: If it is damaged.
          KeyError: If there is no array of that name.
        """
        member = self._members[name]
        with self._archive.open(member) as stream:
            assert isinstance(stream, io.BufferedIOBase)  # as ZipExtFile is
            return _read_array(stream, member.file_size)


@contextlib.contextmanager
def archive(path: AnyPath, most: int = MAX_BYTES) -> Iterator[Archive]:
    """Open a .npz file.

    Args:
      path: The file.
      most: Largest number of bytes of all arrays together.

    Yields:
      The archive.

    Raises:
      ValueError: If the file, or an array read in the block, is damaged or too large,
        with a one-line reason without the path.
      CaptureError: If it cannot be opened.
    """
    try:
        with safe_files.open_file(path) as file:
            size = os.fstat(file.fileno()).st_size
            with zipfile.ZipFile(file) as zip_file:
                yield Archive(zip_file, size, most)
    except safe_files.CaptureError:
        raise
    except (*DAMAGED, OSError, NotImplementedError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(reason) from error


def read_arrays(path: AnyPath, most: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """Read all arrays of a .npz file.

    Args:
      path: The file.
      most: Largest number of bytes of all arrays together.

    Returns:
      Arrays by name.

    Raises:
      ValueError: If it is damaged or too large, with a one-line reason without the
        path.
      CaptureError: If it cannot be opened.
    """
    with archive(path, most) as zip_file:
        return {name: zip_file.read(name) for name in zip_file.names}


def load_arrays(
    path: pathlib.Path, names: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """Read arrays of numbers or booleans from a .npz file that a user provides.

    Args:
      path: The file.
      names: Names of the arrays to read, as far as they exist. None reads all.

    Returns:
      Arrays by name.

    Raises:
      CaptureError: If it is damaged or too large, or if one of these arrays does not
        hold numbers.
    """
    try:
        with archive(path) as zip_file:
            members = [n for n in zip_file.names if names is None or n in names]
            arrays = {name: zip_file.read(name) for name in members}
    except safe_files.CaptureError:
        raise
    except ValueError as error:
        raise safe_files.CaptureError(
            f"{path}: not a readable .npz ({error}); save it again with numpy.savez"
        ) from None
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub":
            raise safe_files.CaptureError(
                f"{path}: {name} is {array.dtype} of shape {array.shape}; expected an "
                "array of numbers"
            )
    return arrays


def load_array(path: pathlib.Path, most: int, kinds: str = "fiu") -> np.ndarray:
    """Read a .npy file of numbers that a user provides.

    Args:
      path: The file.
      most: Largest number of values.
      kinds: NumPy's codes of the accepted types: f, i, u, and b for booleans.

    Returns:
      The array.

    Raises:
      CaptureError: If it is damaged, larger, or not an array of numbers.
    """
    most_bytes = 8 * most + MAX_HEADER
    with safe_files.open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        try:
            if size > most_bytes:
                raise ValueError(f"{size} bytes; at most {most_bytes} are read")
            array = _read_array(file, size)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise safe_files.CaptureError(
                f"{path}: not a readable array ({reason}); save it again with "
                "numpy.save"
            ) from None
    if array.dtype.kind not in kinds:
        raise safe_files.CaptureError(
            f"{path}: not an array of numbers; save it with numpy.save"
        )
    if array.size > most:
        raise safe_files.CaptureError(
            f"{path}: {array.size} numbers; at most {most} are read"
        )
    return array


def _read_array(stream: io.BufferedIOBase, size: int) -> np.ndarray:
    """Read one array in NumPy's format."""
    shape, column_major, dtype, header_bytes = _header(stream)
    count = math.prod(shape)
    if count * dtype.itemsize != size - header_bytes:
        raise ValueError(
            f"its header claims {dtype} of shape {shape}, which does not match "
            f"{size - header_bytes} bytes"
        )
    array = np.empty(count, dtype)
    remaining = array.view(np.uint8).data if array.nbytes else memoryview(b"")
    while remaining:
        part = stream.readinto(remaining[:_CHUNK])
        if not part:
            raise ValueError(f"truncated: {len(remaining)} of {size} bytes are missing")
        remaining = remaining[part:]
    return array.reshape(shape, order="F" if column_major else "C")


def _header(stream):
    """Shape, order, type and length in bytes of a header."""
    head = stream.read(8)
    if head[:6] != b"\x93NUMPY" or len(head) < 8:
        raise ValueError("not an array in NumPy's format")
    wide = head[6] > 1
    size = stream.read(4 if wide else 2)
    length = int.from_bytes(size, "little")
    if head[6] not in (1, 2, 3) or length > MAX_HEADER:
        raise ValueError(f"a header of version {head[6]} and {length} bytes")
    text = stream.read(length)
    # NumPy parses the header as Python code, so any exception may occur.
    try:
        formats = np.lib.format
        parse = formats.read_array_header_2_0 if wide else formats.read_array_header_1_0
        shape, column_major, dtype = parse(io.BytesIO(size + text))
    except Exception as error:
        raise ValueError(f"its header is damaged ({type(error).__name__})") from None
    if dtype.hasobject or not dtype.itemsize:
        raise ValueError(f"it holds {dtype}; Python objects are not loaded")
    if len(shape) > MAX_AXES or any(side < 0 for side in shape):
        raise ValueError(f"an array of shape {shape}"[:200])
    return shape, column_major, dtype, len(head) + len(size) + length
