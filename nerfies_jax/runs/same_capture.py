"""Test that a capture is still the one that a run was started with.

It compares numbers with tolerances instead of a digest, because other decoders or
processors change images by a level and cameras by rounding.
"""

import pathlib

import numpy as np

from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.capture.npz_files import read_arrays

KEPT = "capture.npz"
BLOCKS = 8  # an image is kept as the means of so many blocks a side
LEVELS = 3.0  # of 255, between the means of a block
TOLERANCE = 1e-3  # of cameras, times and bounds: relative, and in their own units


def record(folder: pathlib.Path, capture: Capture) -> None:
    """Store in a run folder the numbers that identify its capture.

    Args:
      folder: The run folder.
      capture: The capture.
    """
    with replaced_file(folder / KEPT) as partial, open(partial, "wb") as file:
        np.savez_compressed(file, **_told(capture))


def check(folder: pathlib.Path, capture: Capture) -> None:
    """Check that a capture is the one that a run was started with.

    Runs of former versions, which stored nothing, are not checked.

    Args:
      folder: The run folder.
      capture: The capture.

    Raises:
      CaptureError: If it differs, with the first frame that does.
    """
    path = folder / KEPT
    if not path.is_file():
        return
    try:
        before = read_arrays(path)
        unlike = _unlike(before, _told(capture))
    except (ValueError, KeyError) as error:
        raise CaptureError(
            f"{path}: not what a run keeps of its capture ({error}); remove the file "
            "if the capture is as it was"
        ) from error
    if unlike is not None:
        raise CaptureError(
            f"{capture.path or capture.name}: {unlike} than when {folder} was begun; "
            "undo the change, or start anew in another folder, out=..."
        )


def _told(capture):
    """All by name, a row for each frame where it is of frames."""
    ids = np.array(capture.ids)
    cameras = {f"camera {k}": v for k, v in capture.cameras._asdict().items()}
    bounds = np.array([capture.near, capture.far, capture.scale, *capture.center])
    return {
        "frames": ids,
        "size": np.array(capture.size),
        "frames to learn from": np.sort(ids[capture.train]),
        "held-out frames": np.sort(ids[capture.heldout]),
        "bounds, scale or center": bounds,
        "times": capture.times,
        **cameras,
        "pictures": np.stack([_means(image) for image in capture.images]),
    }


def _means(image):
    """Means over the blocks of an image [height, width, 3]: [blocks, blocks, 3]."""
    rows, columns = (
        np.linspace(0, side, min(BLOCKS, side), endpoint=False, dtype=int)
        for side in image.shape[:2]
    )
    sums = np.add.reduceat(image, rows, axis=0, dtype=np.uint32)
    sums = np.add.reduceat(sums, columns, axis=1)
    height = np.diff(rows, append=image.shape[0])
    width = np.diff(columns, append=image.shape[1])
    return (sums / np.outer(height, width)[..., None]).astype(np.float32)


def _unlike(before, now):
    """Describe the first difference, or return None if there is none."""
    for name, new in now.items():
        old = before[name]
        if old.dtype.kind == "U" or old.shape != new.shape:
            if not np.array_equal(old, new):
                return f"other {name}"
            continue
        bound = LEVELS if name == "pictures" else TOLERANCE * (1 + np.abs(old))
        far = ~(np.abs(new.astype(np.float64) - old) <= bound)
        if far.any():
            if name in ("size", "bounds, scale or center"):
                return f"other {name}"
            row = int(np.argmax(far.reshape(len(far), -1).any(axis=1)))
            return f"other {name} ({now['frames'][row]} first)"
    return None
