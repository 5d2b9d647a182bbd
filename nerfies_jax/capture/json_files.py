"""JSON and file names from strangers: bounded, typed, never outside their folder."""

import contextlib
import json
import os
import pathlib
import re
import shutil
import tempfile
from typing import Any

import msgspec

from nerfies_jax.capture.capture import CaptureError

MAX_JSON_BYTES = 256 * 2**20  # 20 000 frames of transforms.json are 20 MB

AnyPath = str | os.PathLike


def read_json(path: AnyPath, kind: Any = Any) -> Any:
    """The file decoded as `kind`; a NaN, a wrong type or an absent key is an error."""
    path = pathlib.Path(path)
    try:
        size = path.stat().st_size
        if size > MAX_JSON_BYTES:
            raise CaptureError(
                f"{path}: {size} bytes of JSON; at most {MAX_JSON_BYTES} are read"
            )
        text = path.read_bytes()
    except OSError as error:
        raise CaptureError(
            f"{path}: {error.strerror or error}; check the path"
        ) from None
    try:
        return msgspec.json.decode(text, type=kind)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        bad = re.search(rb"(?<![\w\"'])-?(NaN|Infinity|inf|nan)\b", text)
        if bad:
            line = text.count(b"\n", 0, bad.start()) + 1
            raise CaptureError(
                f"{path}: {bad.group().decode()} on line {line}; every number must be "
                "finite, so mend that entry or leave the frame out"
            ) from None
        reason = str(error).replace("\n", " ")
        raise CaptureError(
            f"{path}: {reason}; mend the file or export it again"
        ) from None


def write_json(path: AnyPath, value: Any):
    """Written beside and renamed, so a reader never sees half a file."""
    with replaced_file(path) as partial:
        partial.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n")


def inside(root: pathlib.Path, name: str, named_in: pathlib.Path) -> pathlib.Path:
    """`root / name`, unless that leaves `root`, also through a symbolic link."""
    target = root / name
    if not target.resolve().is_relative_to(root.resolve()) or "\0" in name:
        raise CaptureError(
            f"{named_in}: the name {name!r} leads outside {root}; names must stay in "
            "the capture's folder, so copy the file there"
        )
    return target


@contextlib.contextmanager
def replaced_file(path: AnyPath):
    """A path to write to; it takes the name `path` when the block ends well.

    What is in it is on disk before it takes the name: after a power cut the file is the
    old one or the new one, whole.
    """
    path = pathlib.Path(path)
    # The suffix stays last: image and video writers choose the format by it.
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        with partial.open("r+b") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
        _sync_names(path.parent)
    except OSError as error:
        raise CaptureError(
            f"{path}: cannot be written ({error.strerror or error}); choose another "
            "place"
        ) from None
    finally:
        partial.unlink(missing_ok=True)


def _sync_names(folder):
    """Put the names in a folder on disk, where the system can: Windows cannot."""
    with contextlib.suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


@contextlib.contextmanager
def new_folder(path: AnyPath):
    """A temporary folder beside `path` that becomes `path` when the block ends well."""
    with scratch_folder(path) as partial:
        yield partial
        partial.chmod(0o755)  # mkdtemp makes it private
        os.replace(partial, pathlib.Path(path).resolve())


def refuse_existing(path: AnyPath, overwrite: bool) -> None:
    """Raise where something is at `path` already and may not be written over."""
    path = pathlib.Path(path)
    empty = path.is_dir() and not any(path.iterdir())
    if not overwrite and path.exists() and not empty:
        raise CaptureError(
            f"{path}: already there; choose another name or add --overwrite"
        )


@contextlib.contextmanager
def replaced_folder(path: AnyPath, overwrite: bool = False):
    """`new_folder`, which with `overwrite` takes the place of an earlier one.

    An earlier folder goes once the new one is whole, and only where every file in it
    has its like in the new one, up to the numbers in its name: nothing else is lost.
    """
    path = pathlib.Path(path)
    refuse_existing(path, overwrite)
    if not path.is_dir() or not any(path.iterdir()):
        with new_folder(path) as partial:
            yield partial
        return
    path = path.resolve()
    with scratch_folder(path.with_name(f".{path.name}.replaced")) as scratch:
        new, old = scratch / "new", scratch / "old"
        new.mkdir()
        yield new
        written = set(_kinds(new))
        for kind, name in _kinds(path).items():
            if kind not in written:
                raise CaptureError(
                    f"{path}: holds {name}, which would be lost; choose another name "
                    "or move it away"
                )
        os.replace(path, old)
        try:
            os.replace(new, path)
        except OSError:
            os.replace(old, path)
            raise


def _kinds(folder):
    """The files below a folder, by their paths with the numbers left out."""
    paths = (p.relative_to(folder) for p in folder.rglob("*") if not p.is_dir())
    return {re.sub(r"\d+", "#", str(path)): path for path in paths}


@contextlib.contextmanager
def scratch_folder(path: AnyPath):
    """A temporary folder beside the new folder `path`, gone when the block ends.

    What is renamed to `path` then must name it by its real path: neither "." nor a link
    can be renamed to.
    """
    path = pathlib.Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise CaptureError(f"{path}: already there; choose another name or remove it")
    real = path.resolve()
    if os.path.ismount(real):
        raise CaptureError(
            f"{path}: a whole mounted disk, which no new folder can replace; name a "
            "folder in it"
        )
    try:
        real.parent.mkdir(parents=True, exist_ok=True)
        partial = pathlib.Path(
            tempfile.mkdtemp(prefix=f".{real.name}.", dir=real.parent)
        )
    except OSError as error:
        raise CaptureError(
            f"{path}: cannot be written ({error.strerror or error}); choose another "
            "place"
        ) from None
    try:
        yield partial
    except OSError as error:
        raise CaptureError(
            f"{path}: cannot be written ({error.strerror or error}); choose another "
            "place"
        ) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
