"""Where files are kept that can be made again."""

import os
import pathlib

CACHE = (
    pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")
    / "nerfies_jax"
)
