"""Location of the cache folder."""

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
