"""The one place that imports pycolmap.

Its wheel exports a zlib of its own (seen in 4.2.1). A libz loaded after it binds to
half of that, and the next PNG, .npz or gzip ends the process with "free(): invalid
pointer". Loaded before it, libz stays whole; hence the first import below.
"""

import zlib  # noqa: F401

from nerfies_jax.capture import extras

MIN_TRACK = 3  # pictures that must show a point that counts: so many are needed


def library():
    """Import pycolmap on first use, which takes 0.2 s.

    Returns:
      The module.

    Raises:
      MissingExtra: If it is not installed.
    """
    return extras.library("pycolmap", "sfm")
