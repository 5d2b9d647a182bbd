"""Arrays out of archives that anybody may have written, or cut short."""

import zipfile
import zlib

import numpy as np

from nerfies_jax.capture.json_files import AnyPath

# What zipfile, zlib and NumPy raise for damaged bytes, beside OSError. A RuntimeError
# is an unknown compression or a password, an AttributeError a .npy.
DAMAGED = (
    *(ValueError, KeyError, TypeError, AttributeError, IndexError, EOFError),
    *(zipfile.BadZipFile, zlib.error, RuntimeError),
)


def read_arrays(path: AnyPath) -> dict[str, np.ndarray]:
    """All arrays of a .npz, by name; none of Python's objects.

    Raises ValueError, one line that says why it cannot be read, and OSError.
    """
    try:
        # Opened here: where it is no archive, NumPy leaves the file open.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except DAMAGED as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(reason) from error
