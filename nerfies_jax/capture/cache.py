"""Location of files that can be recreated."""

import os
import pathlib


def _home():
    """The user's cache folder. A relative one does not count, as XDG says.

    It would be in whatever folder is current, a stranger's, say, and compiled programs
    are loaded from it.
    """
    named = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or "")
    return named if named.is_absolute() else pathlib.Path.home() / ".cache"


CACHE = _home() / "nerfies_jax"
