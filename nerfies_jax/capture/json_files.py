"""JSON and file names from untrusted sources, and atomic replacement of files.

JSON is limited in size and typed, and names cannot lead out of their folder. While a
file or folder is written, it has a hidden name next to its final one:
`.NAME.OWNER.partial`, or `.NAME.OWNER.RANDOM.partial` for folders. OWNER identifies the
process and its machine. `sweep` removes such files of killed processes before anything
else is written to the folder.
"""

import contextlib
import json
import os
import pathlib
import re
import shutil
import tempfile
from collections.abc import Collection, Iterable
from typing import Any

import msgspec

from nerfies_jax.capture import safe_files, text_files
from nerfies_jax.capture.errors import CaptureError
from nerfies_jax.capture.safe_files import AnyPath as AnyPath
from nerfies_jax.runtime import processes, stopping

# A transforms.json of 20 000 frames has 20 MB. Decoded, it may take 20 times as much.
MAX_JSON_BYTES = 64 * 2**20

# Incomplete files of this process, and folders that it has swept.
_partial_paths: set[pathlib.Path] = set()
_swept_folders: set[pathlib.Path] = set()

_LEFT_BEHIND = re.compile(
    rf"\.(?P<name>.+)\.(?P<owner>{processes.PATTERN})"
    r"(\.[a-z0-9_]{8})?\.(?P<kind>partial|earlier)(\.[^.]+)?"
)


def read_json(path: AnyPath, kind: Any = Any) -> Any:
    """Read a JSON file.

    Args:
      path: The file.
      kind: Type to decode it as, for msgspec.

    Returns:
      The decoded value.

    Raises:
      CaptureError: If it is not JSON, has a NaN or a number that float64 cannot hold,
        is nested too deeply for the decoder, has a wrong type or lacks a key.
    """
    path = pathlib.Path(path)
    text = safe_files.read_bytes(path, MAX_JSON_BYTES)
    try:
        text = text_files.utf8(text)
        return msgspec.json.decode(text, type=kind)
    except UnicodeDecodeError as error:
        raise CaptureError(
            f"{path}: not text in {error.encoding} (byte {error.start}); save the file "
            "as UTF-8"
        ) from None
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        bad = re.search(rb"(?<![\w\"'])-?(NaN|Infinity|inf|nan)\b", text)
        if bad:
            line = text.count(b"\n", 0, bad.start()) + 1
            raise CaptureError(
                f"{path}: {bad.group().decode()} on line {line}; every number must be "
                "finite, so mend that entry or leave the frame out"
            ) from None
        reason = str(error).replace("\n", " ")
        way_out = "mend the file or export it again"
        if "UTF-8" in reason:
            way_out = "save the file as UTF-8"
        raise CaptureError(f"{path}: {reason}; {way_out}") from None


def write_json(path: AnyPath, value: Any):
    """Write a JSON file atomically, so a reader never sees half a file.

    Args:
      path: The file.
      value: JSON values, all finite.
    """
    with replaced_file(path) as partial:
        partial.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n")


def probe(folder: AnyPath) -> None:
    """Write some data to a folder, to find out why another program could not.

    Args:
      folder: The folder.

    Raises:
      OSError: If it cannot be written.
    """
    with tempfile.TemporaryFile(dir=os.fspath(folder)) as file:
        file.write(bytes(4096))
        file.flush()


def inside(root: pathlib.Path, name: str, named_in: pathlib.Path) -> pathlib.Path:
    """Join a folder and a name, and refuse names that leave the folder.

    Symbolic links are followed, and backslashes count as separators.

    Args:
      root: The folder.
      name: Relative path from a file.
      named_in: File that contains the name, for error messages.

    Returns:
      The path.

    Raises:
      CaptureError: If the name leads outside the folder.
    """
    target = root / text_files.forward_slashes(name)
    if "\0" in name or not all(
        _real(path).is_relative_to(_real(root)) for path in (root / name, target)
    ):
        raise CaptureError(
            f"{named_in}: the name {name!r} leads outside {root}; names must stay in "
            "the capture's folder, so copy the file there"
        )
    return target


def _real(path):
    # Path.resolve raises RuntimeError where links form a circle.
    return pathlib.Path(os.path.realpath(path))


def named_file(root: pathlib.Path, name: str, named_in: pathlib.Path) -> pathlib.Path:
    """Join a folder and a name like `inside`, spelled as on disk if the file exists.

    Args:
      root: The folder.
      name: Relative path from a file.
      named_in: File that contains the name, for error messages.

    Returns:
      The path.

    Raises:
      CaptureError: If the name leads outside the folder.
    """
    target = inside(root, name, named_in)
    file = text_files.find(root, name)
    if file is None:
        return target
    inside(root, str(file.relative_to(root)), named_in)
    return file


@contextlib.contextmanager
def replaced_file(path: AnyPath):
    """Replace a file atomically.

    The content is flushed to disk before the file takes its name. After a power failure
    the file is either the old or the new one, complete.

    Args:
      path: The file.

    Yields:
      A temporary path to write to, which becomes `path` when the block ends without an
      error.

    Raises:
      CaptureError: If it cannot be written.
    """
    path = pathlib.Path(path)
    _sweep_once(path.parent)
    # The suffix stays last, since writers of images and videos choose the format by it.
    partial = path.with_name(
        f".{path.stem}.{processes.own_name()}.partial{path.suffix}"
    )
    _register(partial)
    try:
        yield partial
        with partial.open("r+b") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise _unwritable(path, error) from None
    finally:
        with contextlib.suppress(OSError):  # the disk may have become read-only
            partial.unlink(missing_ok=True)
        _partial_paths.discard(partial)


def _unwritable(path, error):
    return CaptureError(
        f"{path}: cannot be written ({error.strerror or error}); choose another place"
    )


def _sync_folder(folder):
    """Flush the names in a folder to disk, if the system supports it (not Windows)."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _register(partial):
    """Register an incomplete file for removal if a signal ends the process."""
    _partial_paths.add(partial)
    stopping.at_end(_remove_unfinished)


def _remove_unfinished():
    for path in list(_partial_paths):
        _remove(path)


def _remove(path):
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def _sweep_once(folder):
    """Sweep a folder before this process writes its first file there."""
    folder = folder.absolute()
    if folder not in _swept_folders:
        _swept_folders.add(folder)
        sweep(folder)


def sweep(folder: AnyPath) -> list[pathlib.Path]:
    """Clean up hidden files that killed processes of this machine left in a folder.

    Incomplete files and folders are removed. If a process was killed while it replaced
    a folder, the earlier folder gets its name back.

    Args:
      folder: The folder. Its subfolders are not searched.

    Returns:
      The hidden paths that were removed or renamed.
    """
    cleaned_paths: list[pathlib.Path] = []
    try:
        paths = sorted(pathlib.Path(folder).glob(".*"))
    except OSError:
        return cleaned_paths
    for path in paths:
        match = _LEFT_BEHIND.fullmatch(path.name)
        if match is None or not processes.has_ended(match["owner"]):
            continue
        if match["kind"] == "earlier" and not (path.parent / match["name"]).exists():
            with contextlib.suppress(OSError):
                os.replace(path, path.parent / match["name"])
        else:
            _remove(path)
        cleaned_paths.append(path)
    return cleaned_paths


@contextlib.contextmanager
def new_folder(path: AnyPath):
    """Create a folder atomically.

    Args:
      path: The folder, which may be absent or empty.

    Yields:
      A temporary folder that becomes `path` when the block ends without an error.
    """
    with scratch_folder(path) as partial:
        yield partial
        partial.chmod(0o755)  # mkdtemp makes it private
        os.replace(partial, pathlib.Path(path).resolve())


def refuse_existing(path: AnyPath, overwrite: bool) -> None:
    """Refuse to overwrite an existing file or folder.

    Args:
      path: File or folder to be written. An empty folder does not count as existing.
      overwrite: True to allow it.

    Raises:
      CaptureError: If it exists and `overwrite` is False.
    """
    path = pathlib.Path(path)
    empty = path.is_dir() and not any(path.iterdir())
    if not overwrite and path.exists() and not empty:
        raise CaptureError(
            f"{path}: already there; choose another name or set overwrite=True"
        )


@contextlib.contextmanager
def replaced_folder(
    path: AnyPath, overwrite: bool = False, replaceable: Collection[str] | None = None
):
    """Replace a folder once its successor is complete.

    The earlier folder is unchanged until the block ends without an error. It is not
    replaced if it holds files that would be lost.

    Args:
      path: The folder. It may be absent or empty.
      overwrite: True if a folder with files may be replaced.
      replaceable: Files of the earlier folder that may be deleted, by their paths
        relative to it. If it holds others, an error is raised before the block begins.
        By default files may be deleted whose names equal those of files in the new
        folder up to numbers, which is checked when the block ends.

    Yields:
      The temporary folder to write into.

    Raises:
      CaptureError: If the folder may not be replaced, or cannot be written.
    """
    path = pathlib.Path(path)
    sweep(path.resolve().parent)
    refuse_existing(path, overwrite)
    if not path.is_dir() or not any(path.iterdir()):
        with new_folder(path) as partial:
            yield partial
        return
    path = path.resolve()
    if replaceable is not None:
        _refuse_others(path, replaceable)
    with _partial_folder(path, path.parent) as scratch:
        new = scratch / "new"
        new.mkdir()
        yield new
        files = _files(new)
        _refuse_others(path, alike(path, files) if replaceable is None else replaceable)
        _swap_folders(new, path)


@contextlib.contextmanager
def merged_folder(path: AnyPath):
    """Replace files of a folder once all their successors are complete.

    Args:
      path: The folder, which must exist. Its other files are unchanged.

    Yields:
      A temporary folder inside it. When the block ends without an error, its files are
      renamed to their final paths one by one.
    """
    path = pathlib.Path(path)
    sweep(path)
    with _partial_folder(path, path.resolve()) as partial:
        yield partial
        with stopping.protected():
            for name in _files(partial):
                target = path / name
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(partial / name, target)
        _sync_folder(path)


def _swap_folders(new, path):
    """Rename the new folder to `path`. `sweep` repairs it after an interruption."""
    earlier = path.with_name(f".{path.name}.{processes.own_name()}.earlier")
    with stopping.protected():
        os.replace(path, earlier)
        try:
            os.replace(new, path)
        except BaseException:
            if not path.exists():
                os.replace(earlier, path)
            raise
    _sync_folder(path.parent)
    shutil.rmtree(earlier, ignore_errors=True)


def _refuse_others(path, replaceable):
    """Raise CaptureError if a folder holds a file that is not replaceable."""
    for name in _files(path):
        if name not in replaceable:
            raise CaptureError(
                f"{path}: holds {name}, which would be lost; choose another name or "
                "move it away"
            )


def _files(folder):
    """Paths of the files below a folder, relative to it."""
    return [
        path.relative_to(folder).as_posix()
        for path in sorted(folder.rglob("*"))
        if path.is_symlink() or not path.is_dir()
    ]


def alike(folder: AnyPath, names: Iterable[str]) -> set[str]:
    """List the files of a folder whose names equal any of `names` up to numbers.

    Args:
      folder: The folder. It may be absent.
      names: Paths relative to the folder.

    Returns:
      Paths relative to the folder, with forward slashes.
    """
    kinds = {_without_numbers(name) for name in names}
    files = _files(pathlib.Path(folder))
    return {name for name in files if _without_numbers(name) in kinds}


def _without_numbers(name):
    return re.sub(r"\d+", "#", name)


@contextlib.contextmanager
def scratch_folder(path: AnyPath):
    """Create a temporary folder next to a new folder, removed when the block ends.

    To rename it to `path`, use the real path, since neither "." nor a symbolic link can
    be the target.

    Args:
      path: The new folder, which may be absent or empty.

    Yields:
      The temporary folder.

    Raises:
      CaptureError: If `path` exists or cannot be written.
    """
    path = pathlib.Path(path)
    sweep(path.resolve().parent)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise CaptureError(f"{path}: already there; choose another name or remove it")
    if os.path.ismount(path.resolve()):
        raise CaptureError(
            f"{path}: a mount point, which a new folder cannot replace; choose a "
            "folder in it"
        )
    with _partial_folder(path, path.resolve().parent) as partial:
        yield partial


@contextlib.contextmanager
def _partial_folder(path, parent):
    """Temporary folder in `parent` for the contents of `path`, removed at the end."""
    try:
        parent.mkdir(parents=True, exist_ok=True)
        prefix = f".{path.resolve().name}.{processes.own_name()}."
        partial = pathlib.Path(
            tempfile.mkdtemp(prefix=prefix, suffix=".partial", dir=parent)
        )
    except OSError as error:
        raise _unwritable(path, error) from None
    _register(partial)
    try:
        yield partial
    except OSError as error:
        raise _unwritable(path, error) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        _partial_paths.discard(partial)
