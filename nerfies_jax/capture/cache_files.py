"""Files that can be recreated: caches, and completed parts of long measurements.

All of them are disposable. A file that is damaged, truncated, unreadable, of another
version or of other content is reported in one line and recreated. Undetected damage
would show up as plausible numbers, so each file holds a checksum of its content and the
identity of what it was made for.
"""

import contextlib
import json
import os
import pathlib
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import filelock
import numpy as np

from nerfies_jax.capture import npz_files
from nerfies_jax.capture.json_files import new_folder, replaced_file
from nerfies_jax.capture.json_files import write_json as write_plain_json
from nerfies_jax.runtime import console

SEAL = "seal"  # key of the identity and checksum in archives and JSON objects
MANIFEST = "manifest.json"  # checksums of the files of a folder
DAMAGED = ".damaged"  # suffix of a damaged file that is kept

Content = TypeVar("Content")

# Warnings that were printed, since a file may be requested many times.
_warnings: set[tuple[str, Any]] = set()


def read(
    path: pathlib.Path, load: Callable[[pathlib.Path], Content], aside: bool = False
) -> Content | None:
    """Read a file that can be recreated.

    Args:
      path: The file or folder.
      load: Function that reads it. Any exception means that the file is unusable.
      aside: True to rename an unusable file to NAME.damaged, for files that hold more
        than what the caller recreates now.

    Returns:
      What `load` returns. None if the file does not exist or, with a warning, if it is
      unusable.
    """
    try:
        os.lstat(path)
        return load(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        if not os.path.lexists(path):
            return None
        reason: Exception = error
    # Readers of damaged bytes may raise anything.
    except Exception as error:
        reason = error
    text = " ".join(str(reason).replace(f"{path}: ", "").split())
    message = f"{path}: unusable ({text or type(reason).__name__}); it is recreated"
    if aside:
        backup = path.with_name(path.name + DAMAGED)
        with contextlib.suppress(OSError):
            os.replace(path, backup)
            message += f", and kept as {backup.name}"
    if (key := (message, _state(path))) not in _warnings:
        _warnings.add(key)
        console.warn(message)
    return None


@contextlib.contextmanager
def making(path: pathlib.Path) -> Iterator[None]:
    """Wait until no other process makes the same file, which may exist afterwards.

    Args:
      path: The file. Its folder is created if needed. If it cannot be written, nothing
        is locked.

    Yields:
      None, to read the file or to make it.
    """
    lock_path = path.with_name(f".{path.name}.lock")
    lock = filelock.FileLock(lock_path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except (OSError, NotImplementedError):  # a file system without locks
        yield
        return
    try:
        yield
    finally:
        lock.release()
        # Whoever waits for the removed file finds what has been made.
        with contextlib.suppress(OSError):
            lock_path.unlink(missing_ok=True)


def mark_used(path: pathlib.Path) -> None:
    """Set the time of last use of a file, by which `evict` orders files.

    Args:
      path: The file, which may be absent.
    """
    with contextlib.suppress(OSError):
        os.utime(path)


def evict(folder: pathlib.Path, most_bytes: float | int) -> list[pathlib.Path]:
    """Remove the least recently used files of a cache above a size.

    A process that has opened a removed file can read it to the end. One that opens it
    later finds no file, and recreates it. The newest file always stays.

    Args:
      folder: The folder. Its subfolders and hidden files do not count.
      most_bytes: Size of all files above which some are removed.

    Returns:
      The files that were removed.
    """
    files = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            # Another process may have removed it.
            with contextlib.suppress(OSError):
                if entry.is_file(follow_symlinks=False) and entry.name[0] != ".":
                    status = entry.stat(follow_symlinks=False)
                    use_time = max(status.st_atime_ns, status.st_mtime_ns)
                    files.append((use_time, entry.path, status.st_size))
    total, removed_files = sum(size for *_, size in files), []
    for _, path, size in sorted(files)[:-1]:
        if total <= most_bytes:
            break
        with contextlib.suppress(OSError):  # Windows keeps files that are open
            os.unlink(path)
            total -= size
            removed_files.append(pathlib.Path(path))
    return removed_files


def _state(path):
    """Identify the file at a path, to tell it from others that had the same name."""
    with contextlib.suppress(OSError):
        status = os.lstat(path)
        return status.st_ino, status.st_mtime_ns, status.st_size


def write_arrays(
    path: pathlib.Path, arrays: Mapping[str, np.ndarray], identity: str
) -> None:
    """Write a .npz with its checksum, completely or not at all.

    Args:
      path: The file. Its folder is created if needed.
      arrays: Arrays by name. The name `SEAL` is reserved.
      identity: Identity of the content, with the version of the code that made it.
    """
    seal = json.dumps({"identity": identity, "crc32": _checksum(arrays)})
    _make_way(path)
    contents: dict[str, Any] = {**arrays, SEAL: np.array(seal)}
    with replaced_file(path) as partial:
        np.savez(partial, **contents)


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
    _check(seal is not None and json.loads(str(seal)), identity, _checksum(arrays))
    return arrays


def _checksum(arrays: Mapping[str, np.ndarray]) -> int:
    """Compute the CRC-32 of arrays: their names, types, shapes and bytes."""
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
        raise ValueError("it is of another version or for other content")
    if seal.get("crc32") != crc32:
        raise ValueError("its content changed after it was written (checksum)")


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
    """Check that the files of a folder are unchanged since `replaced_entry` wrote it.

    Args:
      path: The folder.
      identity: Identity that the content must have.

    Raises:
      ValueError: If a file differs.
      OSError: If a file cannot be read.
    """
    for name, crc32 in read_json(path / MANIFEST, identity)["files"].items():
        if _file_checksum(path / name) != crc32:
            raise ValueError(f"{name} changed after it was written (checksum)")


def _files(folder):
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return [path.relative_to(folder).as_posix() for path in paths]


def _file_checksum(path):
    return zlib.crc32(path.read_bytes())


def _make_way(path, folder=False):
    """Remove what `os.replace` cannot replace: a folder, or a file that blocks one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    elif folder and os.path.lexists(path):
        path.unlink()
