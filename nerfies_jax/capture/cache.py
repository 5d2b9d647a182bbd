"""Location and size of the cache folder."""

import os
import pathlib


def _home():
    """The user's cache folder.

    A relative path is ignored, as the XDG base directory specification demands. It
    would depend on the working directory, which may belong to somebody else, and
    compiled programs are loaded from the cache.
    """
    folder = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or "")
    return folder if folder.is_absolute() else pathlib.Path.home() / ".cache"


CACHE = _home() / "nerfies_jax"
LIMIT = "NERFIES_JAX_CACHE_GB"  # environment variable
LIMIT_GB = 10.0


def limit_bytes() -> float:
    """Return the largest size of the cache of preprocessing, and of programs.

    Returns:
      The environment variable `NERFIES_JAX_CACHE_GB`, 10 GB by default, in bytes.

    Raises:
      ValueError: If the variable is not a positive number.
    """
    text = os.environ.get(LIMIT) or str(LIMIT_GB)
    try:
        limit = float(text)
    except ValueError:
        limit = 0.0
    if not limit > 0:
        raise ValueError(
            f"{LIMIT}={text}: must be a number of gigabytes above 0; unset it for "
            f"{LIMIT_GB:g}"
        )
    return 1e9 * limit
