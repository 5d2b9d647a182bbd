"""What made a file: the revision of this library and what its last bits depend on."""

import pathlib
import subprocess
import sys
from typing import Any

import jax
import numpy as np


def provenance() -> dict[str, Any]:
    """What made a checkpoint: revision, versions, and what its last bits depend on."""
    return {
        "revision": revision(),
        "python": sys.version.split()[0],
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": jax.devices()[0].device_kind,
        "x64": bool(jax.config.jax_enable_x64),
    }


def revision(checkout: pathlib.Path | None = None) -> str:
    """Git revision of a checkout, with "+changes"; "unknown" outside git.

    Of none given that which this library runs from.
    """
    here = checkout or pathlib.Path(__file__).resolve().parents[2]
    if not (here / ".git").exists():  # installed, perhaps inside another repository
        return "unknown"
    command = "describe --always --exclude=* --dirty=+changes --abbrev=40"
    try:
        text = subprocess.run(
            ["git", "-C", here, *command.split()],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return text.strip()
