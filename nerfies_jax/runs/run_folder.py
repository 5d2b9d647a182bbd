"""Folder of a run: its creation, its exclusive owner, and the names of its files."""

import contextlib
import datetime
import json
import os
import pathlib
import platform
import tempfile
from collections.abc import Iterator

import filelock

CONFIG = "config.json"  # settings of the run and its complete spec
PREPROCESSING_NOTES = "preprocessing"  # key in CONFIG: notes on skipped preprocessing
CHECKPOINTS = "checkpoints"
EXPORTS = "exports"  # default folder of files for other programs
RENDERS = "renders"  # images and videos of camera paths
PREPARED = "prepared.json"  # in a capture: its source and the conversion settings
LOCK = ".lock"
OWNER = ".owner.json"  # not in LOCK, because Windows does not let locked files be read


def new_run_folder(out: pathlib.Path | None, stem: str) -> pathlib.Path:
    """Create an empty writable folder for a run.

    Args:
      out: The folder. None for `runs/STEM`, or `runs/STEM-2` and so on if it exists.
      stem: Name of the default folder.

    Returns:
      The folder.

    Raises:
      ValueError: If `out` is not empty or cannot be written.
    """
    if out is None:
        return _make_numbered(pathlib.Path("runs"), stem)
    check_free(out)
    with _write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    return out


def newest_of(source: pathlib.Path) -> pathlib.Path:
    """Find the newest run of a capture or video in `runs`.

    Args:
      source: The capture or video.

    Returns:
      The run folder.

    Raises:
      ValueError: If there is none.
    """
    refuse_run(source)
    above = pathlib.Path("runs")
    candidates = []
    for path in above.glob(f"*/{CONFIG}"):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            capture = json.loads(path.read_text())["config"]["source"]["capture"]
            if capture is not None and is_of(pathlib.Path(capture), source):
                candidates.append((path.stat().st_mtime_ns, path.parent))
    if not candidates:
        raise ValueError(
            f"{source}: {above} contains no run of it; pass the run folder with "
            "out=..., or start a new run"
        )
    return max(candidates)[1]


def is_of(capture: pathlib.Path, source: pathlib.Path) -> bool:
    """Test if a capture is the one at `source`, or was made from it.

    Args:
      capture: Folder of the capture.
      source: Capture, video or folder of images.

    Returns:
      True if it is.
    """
    if capture.absolute() == source.absolute():
        return True
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        record = json.loads((capture / PREPARED).read_text())
        return record["source"] == str(source.resolve())
    return False


def refuse_run(source: pathlib.Path) -> None:
    """Refuse a run folder where a capture is expected.

    Args:
      source: Folder of the capture.

    Raises:
      ValueError: If it is a run folder.
    """
    if (source / CONFIG).is_file() and (source / CHECKPOINTS).is_dir():
        raise ValueError(
            f"{source}: a run folder, not a capture; continue the run with "
            f"runs.resume({str(source)!r})"
        )


def check_free(out: pathlib.Path) -> None:
    """Check that a run can begin in a folder, without creating anything.

    Args:
      out: The folder.

    Raises:
      ValueError: If it is not empty or cannot be written.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(
            f"{out}: the run folder is an existing file; choose another path with "
            "out=..."
        )
    if not out.is_dir():
        above = next(path for path in out.absolute().parents if path.exists())
        if not (above.is_dir() and os.access(above, os.W_OK | os.X_OK)):
            raise ValueError(
                f"{out}: the run folder cannot be created, because {above} is not a "
                "writable folder; choose another one with out=..."
            )
        return
    if (out / LOCK).exists():
        with owned(out):
            pass
    # A run that was killed before it wrote anything else leaves these two files.
    if any(path.name not in (LOCK, OWNER) for path in out.iterdir()):
        raise ValueError(
            f"{out}: the run folder is not empty; choose another one with out=..., or "
            "continue the run in it with runs.resume"
        )


@contextlib.contextmanager
def owned(folder: pathlib.Path) -> Iterator[None]:
    """Lock a run folder for writing by this process.

    The operating system releases the lock when the process ends, however it does.

    Args:
      folder: The run folder.

    Yields:
      None, while the lock is held.

    Raises:
      ValueError: If another process holds the lock, with its identity.
    """
    lock = filelock.FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        raise ValueError(
            f"{folder}: {_owner(folder)} is using this run folder; wait until it ends, "
            "or stop it (Ctrl-C or kill), which saves a checkpoint"
        ) from None
    try:
        owner = {
            "pid": os.getpid(),
            "host": platform.node(),
            "since": datetime.datetime.now().astimezone().isoformat(" ", "seconds"),
        }
        (folder / OWNER).write_text(json.dumps(owner))
        yield
    finally:
        with contextlib.suppress(OSError):  # removed, or not writable any more
            (folder / OWNER).unlink()
        lock.release()


def _owner(folder):
    try:
        owner = json.loads((folder / OWNER).read_text())
        return f"process {owner['pid']} on {owner['host']} (since {owner['since']})"
    except (OSError, ValueError, KeyError, TypeError):  # not completely written yet
        return "another process"


def _make_numbered(above, stem):
    """Create the first of STEM, STEM-2, ... that does not exist."""
    number, folder = 1, above / stem
    with _write_errors(folder):
        above.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                folder.mkdir()
                return folder
            except FileExistsError:
                number += 1
                folder = above / f"{stem}-{number}"


@contextlib.contextmanager
def _write_errors(folder):
    """Report write errors in the block with the path and advice."""
    try:
        yield
    except OSError as error:
        raise ValueError(
            f"{folder}: the run folder cannot be written ({error.strerror}); "
            "choose another one with out=..."
        ) from error
