"""Robust reading of PLY files with plyfile."""

import io
import pathlib
import re

import plyfile

from nerfies_jax.capture import safe_files, text_files

MAX_HEADER = 1 << 16  # bytes; plyfile hangs on a header line of 100 MB
MAX_TEXT = 1 << 30  # bytes; plyfile reads text at 5 MB a second
_TYPE_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}


class _Binary(io.BufferedReader):
    """A binary PLY file with non-ASCII bytes of its header replaced by ASCII.

    plyfile refuses them, but programs and users write them into comments.
    """

    header_bytes = 0

    def read(self, size=-1, /):
        in_header = self.tell() < self.header_bytes
        data = super().read(size)
        return bytes(min(byte, 127) for byte in data) if in_header else data


def read(path: pathlib.Path) -> plyfile.PlyData:
    """Read a PLY file whose header may hold any text, in any Unicode encoding.

    Binary elements without lists are memory-mapped, read-only.

    Args:
      path: The file.

    Returns:
      The elements.

    Raises:
      ValueError: If the file is damaged, with a one-line message without the path.
      CaptureError: If it cannot be opened.
    """
    with safe_files.open_file(path) as stream:
        head = stream.read(MAX_HEADER)
    size = path.stat().st_size
    encoding = text_files.encoding_of(head)
    header = check_header(text_files.utf8(head), size)
    is_text = b"format ascii" in header
    if is_text and size > MAX_TEXT:
        raise ValueError(f"{size} bytes of text; save it as a binary PLY")
    try:
        if encoding != "utf-8":  # only text files can have another encoding
            raw = text_files.utf8(safe_files.read_bytes(path, MAX_TEXT))
            text = raw.decode("ascii", "ignore").replace("\r\n", "\n")
            return plyfile.PlyData.read(io.StringIO(text))
        if is_text:
            with path.open(encoding="ascii", errors="ignore") as stream:
                return plyfile.PlyData.read(stream)
        with _Binary(io.FileIO(path)) as stream:
            stream.header_bytes = len(header)
            return plyfile.PlyData.read(stream, mmap="r")
    # plyfile does not validate its input, so any exception may occur.
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(reason) from error


def check_header(head: bytes, size: int) -> bytes:
    """Check that the element counts of a header fit the size of the file.

    Args:
      head: The first bytes of the file.
      size: Bytes of the file.

    Returns:
      The header, including its last line.

    Raises:
      ValueError: If there is no header, or it specifies more than the file can hold.
    """
    if not head.startswith(b"ply"):
        raise ValueError("not a PLY file: it does not start with 'ply'")
    end = re.search(rb"\nend_header\r?\n", head)
    if end is None:
        raise ValueError(
            f"no end_header in its first {MAX_HEADER} bytes: truncated, or not the "
            "header of a point cloud"
        )
    header = head[: end.end()]
    claimed_bytes = 0
    for name, count, row_bytes in _elements(header):
        claimed_bytes += count * max(row_bytes, 1)
        if claimed_bytes > size:
            raise ValueError(f"its header claims {count} of {name} in {size} bytes")
    return header


def _elements(header):
    """Name, count and smallest row size in bytes of each element."""
    is_text = b"format ascii" in header
    elements = []
    for line in header.decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > 20:
                raise ValueError(f"its header has a line {line[:60]!r}")
            elements.append([words[1][:20], int(words[2]), 0])
        elif words[:1] == ["property"] and len(words) >= 3 and elements:
            kind = words[2] if words[1] == "list" else words[1]
            # In text files a digit and a separator.
            elements[-1][2] += 2 if is_text else _TYPE_BYTES.get(kind, 1)
    return elements
