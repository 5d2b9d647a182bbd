"""Safe reading of array archives, which may be damaged or untrusted."""

import zipfile
import zlib

import numpy as np

from nerfies_jax.capture.json_files import AnyPath

# Errors of zipfile, zlib and NumPy for damaged bytes, besides OSError. A RuntimeError
# is an unknown compression or a password, an AttributeError a .npy.
DAMAGED = (
    *(ValueError, KeyError, TypeError, AttributeError, IndexError, EOFError),
    *(zipfile.BadZipFile, zlib.error, RuntimeError),
)


def read_arrays(path: AnyPath) -> dict[str, np.ndarray]:
    """Read all arrays of a .npz, without unpickling objects.

    Args:
      path: The file.

    Returns:
      Arrays by name.

    Raises:
      ValueError: If it is damaged, with a one-line reason.
      OSError: If it cannot be opened.
    """
    try:
        # Opened here: where it is no archive, NumPy leaves the file open.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except DAMAGED as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(reason) from error
