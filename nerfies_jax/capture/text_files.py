"""Text encodings and spellings of file names from other programs."""

import codecs
import functools
import json
import os
import pathlib
import re
import time
import unicodedata
from collections.abc import Sequence

MOST_FOLDERS = 8  # largest number of trailing folders of a path that are matched
_ELSEWHERE = re.compile(r"(file://)?(/|[A-Za-z]:/|(\./)*\.\./)")
# Listings of folders are cached unless the folder changed more recently than this. It
# could change again without a new timestamp.
_SETTLED_NS = 2 * 10**9


def encoding_of(head: bytes) -> str:
    """Detect the Unicode encoding of a text file from its first bytes.

    Args:
      head: The first bytes, at least four if the file has them. Text in UTF-16 or
        UTF-32 is recognized without a byte order mark if it begins with ASCII.

    Returns:
      Name of a codec that also removes the byte order mark, if there is one.
    """
    return json.detect_encoding(head[:4])


def utf8(data: bytes) -> bytes:
    """Re-encode a whole text file as UTF-8 without a byte order mark.

    Args:
      data: Contents of the file.

    Returns:
      The same text as UTF-8.

    Raises:
      UnicodeDecodeError: If the file begins like UTF-16 or UTF-32 and is not.
    """
    encoding = encoding_of(data)
    if encoding == "utf-8":
        return data
    if encoding == "utf-8-sig":
        return data.removeprefix(codecs.BOM_UTF8)
    return data.decode(encoding).encode()


def forward_slashes(name: str) -> str:
    """Replace the backslashes of Windows paths by slashes.

    Args:
      name: A path.

    Returns:
      The path with slashes.
    """
    return name.replace("\\", "/")


def find(
    folder: pathlib.Path, name: str, suffixes: Sequence[str] = ("",)
) -> pathlib.Path | None:
    """Find a file whose name may be spelled differently on disk.

    The exact name is preferred. Otherwise separators may be backslashes, letters may
    differ in case, and characters may be composed (NFC) or decomposed (NFD), since
    copies between operating systems change them. If several files match, none is
    returned.

    Args:
      folder: Folder that the name is relative to.
      name: A relative path. The caller checks that it stays inside the folder.
      suffixes: Endings to try after the name, in order.

    Returns:
      The path of the file, or None.
    """
    plain = forward_slashes(name)
    for spelling in dict.fromkeys((name, plain)):
        for suffix in suffixes:
            path = folder / (spelling + suffix)
            if os.path.isfile(path):  # False of names too long for the system
                return path
    for suffix in dict.fromkeys(map(str.lower, suffixes)):
        path = _respell(folder, plain + suffix)
        if path is not None and os.path.isfile(path):
            return path
    return None


def find_local(
    folder: pathlib.Path, name: str, suffixes: Sequence[str] = ("",)
) -> str | None:
    """Find the local file of an absolute path, or of a path that leaves the folder.

    Captures contain such paths after they were moved from another machine.

    Args:
      folder: Folder of the capture.
      name: A path.
      suffixes: As for `find`.

    Returns:
      The longest trailing part of the path that is a file in the folder, relative to
      it. None for relative paths within the folder, and if there is no such file.
    """
    plain = forward_slashes(name)
    if _ELSEWHERE.match(plain) is None:
        return None
    parts = [part for part in plain.split("/") if part not in ("", ".", "..")]
    for first in range(max(1, len(parts) - MOST_FOLDERS), len(parts)):
        end = "/".join(parts[first:])
        if find(folder, end, suffixes) is not None:
            return end
    return None


def _respell(folder, name):
    """Spell a path as on disk, or return None if no or several spellings match."""
    path = folder
    for part in pathlib.PurePosixPath(name).parts:
        if os.path.exists(path / part):
            path = path / part
            continue
        spellings = _listing(path).get(_key(part), ())
        if len(spellings) != 1:
            return None
        path = path / spellings[0]
    return path


def _key(name):
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _listing(folder):
    """Names in a folder by their case-folded spelling. Empty if it is not a folder."""
    try:
        mtime_ns = folder.stat().st_mtime_ns
        if time.time_ns() - mtime_ns < _SETTLED_NS:
            return _read_listing(str(folder), mtime_ns)
        return _cached_listing(str(folder), mtime_ns)
    except OSError:
        return {}


def _read_listing(folder, _):
    names = {}
    for name in os.listdir(folder):
        names.setdefault(_key(name), []).append(name)
    return names


_cached_listing = functools.lru_cache(16)(_read_listing)
