"""Conversion of a .npz archive of images, poses, times and focal length."""

import math
import pathlib

import numpy as np

from nerfies_jax.capture import formats, npz_files
from nerfies_jax.capture.capture import CaptureError, describe
from nerfies_jax.capture.images import write_png
from nerfies_jax.capture.json_files import AnyPath, new_folder, write_json
from nerfies_jax.capture.splits import HELD_OUT, hold_out_every

SAME_POSE = 1e-6  # tolerance of matrix entries; a static camera repeats them exactly
TRIPOD_ROWS = 5  # smallest number of rows with one pose that form a validation sweep


def convert(
    file: AnyPath, out: AnyPath, heldout: str | None = None, train: str | None = None
) -> list[str]:
    """Convert an archive to transforms_train.json and transforms_val.json with images.

    The archive holds `images`, `poses` (OpenGL camera to world), `focal` and `times`.
    If no rows are specified and consecutive rows share one pose, those are taken for a
    validation sweep over time: they are held out, the rows before them are for
    training, and the rows after them are left out.

    Args:
      file: The archive.
      out: The folder to write.
      heldout: Rows to hold out, as "first:last+1".
      train: Rows for training, as "first:last+1".

    Returns:
      Lines of text about the result.

    Raises:
      CaptureError: If the archive cannot be read.
      ValueError: If the rows are not valid.
    """
    images, poses, times, focal = read_archive(pathlib.Path(file))
    train, heldout, note = _rows_of(poses, heldout, train, str(file))
    common = {"camera_angle_x": 2 * math.atan(images.shape[2] / 2 / focal)}
    background = _background_of(images)
    if background is not None:
        common["background"] = background
    with new_folder(out) as folder:
        for name, rows in (("train", train), ("val", heldout)):
            (folder / name).mkdir()
            entries = []
            for row in rows:
                write_png(folder / name / f"r_{row:04d}.png", images[row])
                entry = {
                    "file_path": f"./{name}/r_{row:04d}",
                    "transform_matrix": poses[row].tolist(),
                }
                if times is not None:
                    entry["time"] = float(times[row])
                entries.append(entry)
            file = folder / f"transforms_{name}.json"
            write_json(file, common | {"frames": entries})
        formats.load(folder)  # reports problems now rather than when it is used
    return [*describe(formats.load(out)), note]


def read_archive(path):
    """Read the arrays of an archive.

    Args:
      path: The archive.

    Returns:
      uint8 images, poses, times or None, and the focal length in pixels.

    Raises:
      CaptureError: If it cannot be read or an array is missing or has a wrong shape.
    """
    arrays = npz_files.load_arrays(path, ("images", "poses", "focal", "times"))
    absent = {"images", "poses", "focal"} - set(arrays)
    if absent:
        raise CaptureError(
            f"{path}: no array {min(absent)!r}; expected images, poses, focal and, for "
            "a dynamic scene, times"
        )
    images, poses, times = arrays["images"], arrays["poses"], arrays.get("times")
    count = len(images) if images.ndim else 0
    if (
        images.ndim != 4
        or not images.size
        or images.shape[3] != 3
        or poses.shape[1:] not in ((4, 4), (3, 4))
    ):
        raise CaptureError(
            f"{path}: images {images.shape} and poses {poses.shape}; expected "
            "[n, height, width, 3] and [n, 4, 4], n at least 1"
        )
    if len(poses) != count or (times is not None and times.shape != (count,)):
        raise CaptureError(
            f"{path}: {count} images but a different number of poses or times; save "
            "one of each per image"
        )
    numbers = [images, poses, arrays["focal"], *([] if times is None else [times])]
    if not all(np.isfinite(each).all() for each in numbers):
        raise CaptureError(
            f"{path}: holds NaN or infinity; correct or remove those rows"
        )
    if times is not None and not (times.min() >= 0 and times.max() <= 1):
        raise CaptureError(
            f"{path}: times from {times.min():g} to {times.max():g}; expected 0 to 1"
        )
    if not arrays["focal"].size:
        raise CaptureError(f"{path}: focal is empty; expected a length in pixels")
    focal = float(np.asarray(arrays["focal"]).ravel()[0])
    if not focal > 0:
        raise CaptureError(f"{path}: focal = {focal:g}; it must be positive")
    if images.dtype != np.uint8:
        if images.min() < 0 or images.max() > 1:
            raise CaptureError(
                f"{path}: images from {images.min():g} to {images.max():g}; expected "
                "uint8, or floats from 0 to 1"
            )
        images = np.round(images * 255).astype(np.uint8)
    return images, poses.astype(float), times, focal


def _rows_of(poses, heldout, train, where):
    """Split rows into training and held-out ones."""
    count = len(poses)
    if heldout is not None:
        heldout_rows = _range(heldout, count, "heldout")
        other_rows = np.setdiff1d(np.arange(count), heldout_rows)
        train_rows = other_rows if train is None else _range(train, count, "train")
        shared_rows = np.intersect1d(train_rows, heldout_rows)
        if shared_rows.size:
            raise ValueError(
                f"train={train} and heldout={heldout} share row {shared_rows[0]}; "
                "held-out frames must not be trained on"
            )
        return train_rows, heldout_rows, "rows as specified"
    if train is not None:
        raise ValueError(f"train={train} needs heldout=FIRST:LAST too")
    length, start = _longest_static_run(poses)
    if TRIPOD_ROWS <= length < count and start > 0:
        return (
            np.arange(start),
            np.arange(start, start + length),
            f"rows {start} to {start + length - 1} share one pose: held out; "
            f"{count - start - length} rows after them left out",
        )
    train_rows, heldout_rows = hold_out_every(count, HELD_OUT, where)
    return train_rows, heldout_rows, f"every {HELD_OUT}th row is held out"


def _longest_static_run(poses):
    """Length and start of the longest run of rows that share one pose."""
    count = len(poses)
    is_static = np.abs(np.diff(poses, axis=0)).max((1, 2)) < SAME_POSE
    best, first = (0, 0), 0
    for row in range(1, count + 1):
        if row == count or not is_static[row - 1]:
            best = max(best, (row - first, -first))
            first = row
    return best[0], -best[1]


def _range(text, count, name):
    try:
        first, last = (int(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(f"{name}={text}: expected first:last+1, as in 50:61") from None
    if not 0 <= first < last <= count:
        raise ValueError(f"{name}={text}: the archive has rows 0 to {count - 1}")
    return np.arange(first, last)


def _background_of(images):
    """Find the background color, if nearly all image corners have the same color."""
    corners = images[:, [0, 0, -1, -1], [0, -1, 0, -1]].reshape(-1, 3)
    median = np.median(corners, axis=0)
    if (corners == median).all(1).mean() < 0.95:
        return None
    return (median / 255).tolist()
