"""The folder of a run: a new one, and the names of what is in it."""

import pathlib
import tempfile

CONFIG = "config.json"  # which capture and which scene, and the whole of its spec
CHECKPOINTS = "checkpoints"


def new_run_folder(out: pathlib.Path | None, stem: str) -> pathlib.Path:
    """An empty writable folder for a run: `out`, or `runs/STEM[-n]`.

    Raises ValueError if `out` holds something already or cannot be written.
    """
    if out is None:
        number, folder = 1, pathlib.Path("runs", stem)
        while folder.exists():
            number += 1
            folder = pathlib.Path("runs", f"{stem}-{number}")
    else:
        folder = out
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder}: the run folder is a file; name another --out")
        if folder.is_dir() and any(folder.iterdir()):
            raise ValueError(
                f"{folder}: the run folder is not empty; name another --out, or "
                "continue the run in it with --resume"
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ValueError(
            f"{folder}: the run folder cannot be written ({error.strerror}); "
            "name another --out"
        ) from error
    return folder
