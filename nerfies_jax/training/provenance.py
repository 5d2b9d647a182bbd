"""Provenance of a file: revision of this library, and environment."""

import pathlib
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def provenance() -> dict[str, Any]:
    """Describe the environment that affects the exact bits of a result.

    Returns:
      Revision, versions of Python, JAX and NumPy, the device and the precision, as JSON
      values.
    """
    return {
        "revision": revision(),
        "python": sys.version.split()[0],
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": jax.devices()[0].device_kind,
        "x64": jnp.result_type(float) == jnp.float64,
    }


def revision(checkout: pathlib.Path | None = None) -> str:
    """Return the Git revision of a checkout.

    Args:
      checkout: Folder of the checkout. None for the one that this library runs from.

    Returns:
      The revision, with "+changes" if files are modified, or "unknown" outside of Git.
    """
    root = checkout or pathlib.Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():  # installed, perhaps inside another repository
        return "unknown"
    command = "describe --always --exclude=* --dirty=+changes --abbrev=40"
    try:
        text = subprocess.run(
            ["git", "-C", root, *command.split()],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return text.strip()
