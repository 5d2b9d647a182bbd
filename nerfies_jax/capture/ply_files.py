"""PLY files of any program, read by plyfile."""

import io
import pathlib

import plyfile

from nerfies_jax.capture import text_files

MAX_HEADER = 1 << 16  # bytes; plyfile hangs on a header line of 100 MB


class _Binary(io.BufferedReader):
    """A binary PLY whose header reads as ASCII, byte for byte.

    plyfile refuses other characters, which programs and users write into comments.
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
      ValueError, OSError, MemoryError, plyfile.PlyParseError: If the file is damaged.
    """
    with path.open("rb") as stream:
        head = stream.read(MAX_HEADER)
    encoding = text_files.encoding_of(head)
    if encoding != "utf-8":  # only text can be encoded otherwise
        text = text_files.utf8(path.read_bytes()).decode("ascii", "ignore")
        return plyfile.PlyData.read(io.StringIO(text.replace("\r\n", "\n")))
    end = head.find(b"end_header")
    if b"format ascii" in head[: max(end, 0)]:
        with path.open(encoding="ascii", errors="ignore") as stream:
            return plyfile.PlyData.read(stream)
    with _Binary(io.FileIO(path)) as stream:
        stream.header_bytes = end
        return plyfile.PlyData.read(stream, mmap="r")
