"""Import of pycolmap, which must happen nowhere else.

The wheel of pycolmap exports the symbols of its own zlib (observed in 4.2.1). If libz
is loaded afterwards, some of its symbols bind to that copy, and the next PNG, .npz or
gzip file ends the process with "free(): invalid pointer". Importing `zlib` first
prevents this.

It also installs glog's handler of SIGTERM, which prints a stack trace and ends the
process where ours would save a run. The handler from before the import is restored.
"""

import zlib  # noqa: F401

from nerfies_jax.capture import extras
from nerfies_jax.runtime import stopping

MIN_TRACK = 3  # smallest number of images that observe a reliable point


def library():
    """Import pycolmap, which takes 0.2 s, on first use.

    Returns:
      The module.

    Raises:
      MissingExtra: If it is not installed.
    """
    with stopping.keeps_handlers():
        return extras.library("pycolmap", "sfm")
