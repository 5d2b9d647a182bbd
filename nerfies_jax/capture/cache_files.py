"""Files that can be made again: caches, and the finished parts of long measurements.

Every one of them is disposable. One that is damaged, cut off, empty, unreadable, of
another version or of something else is reported in one line that names it, and made
again. Silent damage would come back as plausible numbers, so a file holds a checksum of
its content and the identity of what it was made for.
"""

import contextlib
import json
import os
import pathlib
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import numpy as np

from nerfies_jax.capture import npz_files
from nerfies_jax.capture.json_files import new_folder, replaced_file
from nerfies_jax.capture.json_files import write_json as write_plain_json
from nerfies_jax.runtime import console

SEAL = "seal"  # a member of archives and JSON objects, next to the content
MANIFEST = "manifest.json"  # of a folder
DAMAGED = ".damaged"  # ends the name of a file that is kept aside

Content = TypeVar("Content")

_reported: set[tuple[str, Any]] = set()  # a file may be asked for many times


def read(
    path: pathlib.Path, load: Callable[[pathlib.Path], Content], aside: bool = False
) -> Content | None:
    """Read a file that can be made again.

    Args:
      path: The file or folder.
      load: Reads it. Whatever it raises means that the file is of no use.
      aside: True to rename a file of no use to NAME.damaged, because it holds more
        than what is made again now.

    Returns:
      What `load` returns, or None where there is no such file, or one of no use. A
      warning then names it.
    """
    try:
        os.lstat(path)
        return load(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        if not os.path.lexists(path):
            return None
        reason: Exception = error
    # Damaged bytes make readers raise whatever they meet.
    except Exception as error:
        reason = error
    words = " ".join(str(reason).replace(f"{path}: ", "").split())
    words = f"{path}: of no use ({words or type(reason).__name__}); it is made again"
    if aside:
        kept = path.with_name(path.name + DAMAGED)
        with contextlib.suppress(OSError):
            os.replace(path, kept)
            words += f", and kept as {kept.name}"
    if (key := (words, _state(path))) not in _reported:
        _reported.add(key)
        console.warn(words)
    return None


def _state(path):
    """Identify the file at a path, differently for each one that ever had this name."""
    with contextlib.suppress(OSError):
        found = os.lstat(path)
        return found.st_ino, found.st_mtime_ns, found.st_size


def write_arrays(
    path: pathlib.Path,
    arrays: Mapping[str, np.ndarray],
    identity: str,
    compressed: bool = False,
) -> None:
    """Write a .npz with its checksum, completely or not at all.

    Args:
      path: The file. Its folder is created if needed.
      arrays: Arrays by name. None may be named `SEAL`.
      identity: Identity of the content, with the version of the code that made it.
      compressed: True to compress the file.
    """
    seal = json.dumps({"identity": identity, "crc32": checksum(arrays)})
    _make_way(path)
    save = np.savez_compressed if compressed else np.savez
    contents: dict[str, Any] = {**arrays, SEAL: np.array(seal)}
    with replaced_file(path) as partial:
        save(partial, **contents)


def read_arrays(path: pathlib.Path, identity: str) -> dict[str, np.ndarray]:
    """Read a file written by `write_arrays`.

    Args:
      path: The file.
      identity: Identity that the content must have.

    Returns:
      Arrays by name.

    Raises:
      ValueError: If the content is anything else.
      OSError: If it cannot be read.
    """
    arrays = npz_files.read_arrays(path)
    seal = arrays.pop(SEAL, None)
    _check(seal is not None and json.loads(str(seal)), identity, checksum(arrays))
    return arrays


def checksum(arrays: Mapping[str, np.ndarray]) -> int:
    """Compute the CRC-32 of arrays: their names, types, shapes and bytes.

    Args:
      arrays: Arrays by name.

    Returns:
      The checksum.
    """
    total = 0
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total = zlib.crc32(f"{name} {array.dtype.str} {array.shape}".encode(), total)
        total = zlib.crc32(array.reshape(-1).view(np.uint8).data, total)
    return total


def write_json(path: pathlib.Path, value: dict[str, Any], identity: str) -> None:
    """Write a JSON object with its checksum, completely or not at all.

    Args:
      path: The file. Its folder is created if needed.
      value: The object.
      identity: Identity of the content, with the version of the code that made it.
    """
    _make_way(path)
    seal = {"identity": identity, "crc32": _text_checksum(value)}
    write_plain_json(path, {**value, SEAL: seal})


def read_json(path: pathlib.Path, identity: str) -> dict[str, Any]:
    """Read a file written by `write_json`.

    Args:
      path: The file.
      identity: Identity that the content must have.

    Returns:
      The object.

    Raises:
      ValueError: If the content is anything else.
      OSError: If it cannot be read.
    """
    value = json.loads(path.read_bytes())
    seal = value.pop(SEAL, None) if isinstance(value, dict) else None
    _check(seal, identity, _text_checksum(value))
    return value


def _text_checksum(value):
    return zlib.crc32(json.dumps(value, sort_keys=True).encode())


def _check(seal, identity, crc32):
    if not isinstance(seal, dict) or seal.get("identity") != identity:
        raise ValueError("it is of another version, or of something else")
    if seal.get("crc32") != crc32:
        raise ValueError("it is not what was written: the checksum differs")


@contextlib.contextmanager
def replaced_entry(path: pathlib.Path, identity: str) -> Iterator[pathlib.Path]:
    """Replace a folder by a new one with checksums of its files.

    Args:
      path: The folder. An existing one is removed first.
      identity: Identity of the content, with the version of the code that made it.

    Yields:
      A temporary folder that becomes `path` when the block ends without an error.
    """
    _make_way(path, folder=True)
    with new_folder(path) as folder:
        yield folder
        sums = {name: _file_checksum(folder / name) for name in _files(folder)}
        write_json(folder / MANIFEST, {"files": sums}, identity)


def check_entry(path: pathlib.Path, identity: str) -> None:
    """Check that a folder is as `replaced_entry` left it.

    Args:
      path: The folder.
      identity: Identity that the content must have.

    Raises:
      ValueError: If a file differs.
      OSError: If a file cannot be read.
    """
    for name, crc32 in read_json(path / MANIFEST, identity)["files"].items():
        if _file_checksum(path / name) != crc32:
            raise ValueError(f"{name} is not what was written: the checksum differs")


def _files(folder):
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return [path.relative_to(folder).as_posix() for path in paths]


def _file_checksum(path):
    return zlib.crc32(path.read_bytes())


def _make_way(path, folder=False):
    """Remove what cannot be replaced by renaming: a folder, or what stands for one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    elif folder and os.path.lexists(path):
        path.unlink()
