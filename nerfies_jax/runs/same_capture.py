"""Test that a capture is still the one that a run was started with.

Values are compared with tolerances, not by a checksum, because another decoder or
processor may change images by one 8-bit level and cameras by rounding errors.
"""

import pathlib

import numpy as np

from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.capture.npz_files import read_arrays

FILE = "capture.npz"
BLOCKS = 8  # along each side of an image, whose mean colors are stored
LEVEL_TOLERANCE = 3.0  # of 255, of the mean colors
TOLERANCE = 1e-3  # of cameras, times and bounds, absolute plus relative
# Names of arrays in the file that differ from those in messages.
_LABELS = {
    "frames": "the names of frames",
    "size": "the dimensions of the images",
    "frames to learn from": "the training frames",
    "held-out frames": "the held-out frames",
}


def record(folder: pathlib.Path, capture: Capture) -> None:
    """Store the values that identify a capture in a run folder.

    Args:
      folder: The run folder.
      capture: The capture.
    """
    with replaced_file(folder / FILE) as partial, open(partial, "wb") as file:
        np.savez_compressed(file, **_signature(capture))


def check(folder: pathlib.Path, capture: Capture) -> None:
    """Check that a capture is the one that a run was started with.

    Runs of earlier versions, which stored no values, are not checked.

    Args:
      folder: The run folder.
      capture: The capture.

    Raises:
      CaptureError: If it differs, with the name of the first frame that does.
    """
    path = folder / FILE
    if not path.is_file():
        return
    try:
        difference = _difference(read_arrays(path), _signature(capture))
    except (ValueError, KeyError) as error:
        raise CaptureError(
            f"{path}: not a valid description of the capture of a run ({error}); "
            "remove the file if the capture has not changed"
        ) from error
    if difference is not None:
        raise CaptureError(
            f"{capture.path or capture.name}: {difference} since {folder} was started; "
            "undo the change, or start a new run in another folder, out=..."
        )


def _signature(capture):
    """Return arrays by name. Those that belong to frames have one row per frame."""
    ids = np.array(capture.ids)
    fields = capture.cameras._asdict().items()
    cameras = {f"camera {k}": v for k, v in fields if v is not None}
    bounds = np.array([capture.near, capture.far, capture.scale, *capture.center])
    return {
        "frames": ids,
        "size": np.array(capture.size),
        "frames to learn from": np.sort(ids[capture.train]),  # keys of stored files
        "held-out frames": np.sort(ids[capture.heldout]),
        "bounds, scale or center": bounds,
        "times": capture.times,
        **cameras,
        "images": np.stack([_means(image) for image in capture.images]),
    }


def _means(image):
    """Mean colors of the blocks of an image [height, width, 3]: [blocks, blocks, 3]."""
    rows, columns = (
        np.linspace(0, side, min(BLOCKS, side), endpoint=False, dtype=int)
        for side in image.shape[:2]
    )
    sums = np.add.reduceat(image, rows, axis=0, dtype=np.uint32)
    sums = np.add.reduceat(sums, columns, axis=1)
    height = np.diff(rows, append=image.shape[0])
    width = np.diff(columns, append=image.shape[1])
    return (sums / np.outer(height, width)[..., None]).astype(np.float32)


def _difference(before, now):
    """Describe the first difference, or return None if there is none."""
    for name, new in now.items():
        old, label = before[name], _LABELS.get(name, name)
        if old.dtype.kind == "U" or old.shape != new.shape:
            if not np.array_equal(old, new):
                return f"{label} have changed"
            continue
        images = name == "images"
        bound = LEVEL_TOLERANCE if images else TOLERANCE * (1 + np.abs(old))
        outside = ~(np.abs(new.astype(np.float64) - old) <= bound)
        if outside.any():
            if name in ("size", "bounds, scale or center"):
                return f"{label} have changed"
            row = int(np.argmax(outside.reshape(len(outside), -1).any(axis=1)))
            return f"{label} have changed (first at frame {now['frames'][row]})"
    return None
