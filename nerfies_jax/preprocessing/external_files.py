"""External tracks, masks, depth and flow in files, checked against a capture.

Each has as many frames as the capture, or as its training frames, in temporal order,
and is in pixels of the images as they were captured, with their lens distortion.
"""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from nerfies_jax.capture import (
    decoder,
    exr,
    frames,
    images,
    masks,
    npz_files,
    safe_files,
)
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.external import ExternalFiles, ExternalResults
from nerfies_jax.preprocessing import external_arrays, external_tracks, networks

FLO_MAGIC = 202021.25  # of Middlebury's .flo
IMAGES, DEPTHS = (".png",), (".exr", ".png", ".npy")


@decoder.session()
def attached(
    capture: Capture, files: ExternalFiles, folder: pathlib.Path = networks.FOLDER
) -> Capture:
    """Read external files, except for times, and attach them to a capture.

    Networks are run on the training images.

    Args:
      capture: The capture.
      files: The files.
      folder: Cache folder for results of networks.

    Returns:
      The capture with `external` set.

    Raises:
      CaptureError: If a file does not fit, or a network cannot be run.
      MissingExtra: If a network needs a package that is not installed.
    """
    if files == ExternalFiles(times=files.times):  # times are read with the capture
        return capture
    parts: dict[str, Any] = {}
    notes = capture.notes
    if files.tracks is not None:
        parts |= external_tracks.read(pathlib.Path(files.tracks), capture)
    if files.masks is not None:
        parts["moving"], mask_notes = _masks(files.masks, capture)
        notes += mask_notes
    if files.depths is not None:
        parts["depth"] = _depths(files.depths, capture)
    if files.flow is not None:
        parts |= _flow(files.flow, capture)
    if files.depth_model is not None:
        depths = networks.depths(capture, files.depth_model, folder=folder)
        parts |= depths._asdict()
    if files.segmentation_model is not None:
        moving = networks.segments(capture, files.segmentation_model, folder=folder)
        share = moving[capture.train].mean()
        note = f"{share:.1%} of the pixels are segmented by a network: moving"
        if 0 < share < 1:
            parts["moving"] = moving
        else:
            note = (
                f"the segmentation network marks {'all' if share else 'none'} of the "
                "pixels, and is not used"
            )
        notes += (note,)
    return dataclasses.replace(
        capture, external=ExternalResults(capture.size, **parts), notes=notes
    )


def _files(folder, suffixes, capture, what):
    """Return the files of a folder and their rows, by frame names or by number."""
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder of {what}; check the path")
    paths = [path for path in folder.iterdir() if path.suffix.lower() in suffixes]
    paths.sort(key=lambda path: frames.natural(path.name))
    by_name = {path.name.partition(".")[0]: path for path in paths}
    by_id = [row for row, name in enumerate(capture.ids) if name in by_name]
    if set(capture.train) <= set(by_id):
        return [by_name[capture.ids[row]] for row in by_id], np.array(by_id)
    if not paths:
        raise CaptureError(
            f"{folder}: contains no {what} ({' or '.join(suffixes)} files)"
        )
    return paths, external_arrays.frames_of(len(paths), capture, folder, what)


def _masks(folder, capture):
    paths, rows = _files(folder, IMAGES, capture, "masks")
    moving = np.zeros(capture.images.shape[:3], bool)
    encoding = masks.find_encoding(paths)
    for path, row in zip(paths, rows, strict=True):
        mask = masks.read_mask(path, encoding)
        moving[row] = _resample(mask, capture, path, "mask")
    share = moving[rows].mean()
    if share in (0, 1):
        raise CaptureError(
            f"{folder}: no {'white' if share == 0 else 'black'} pixel in any mask "
            f"({encoding.text}); moving objects must be white, and the rest black"
        )
    note = f"{len(paths)} masks of {encoding.text}; {share:.1%} white: moving"
    return moving, (note,)


def _resample(array, capture, path, what):
    """Resample an array of the aspect of the images to their size (nearest pixel)."""
    width, height = capture.size
    tall, wide = array.shape[:2]
    # To within a pixel of the smaller of the two.
    if abs(wide * height - tall * width) > max(width, height, wide, tall):
        advice = "their aspect ratios must match: export it uncropped"
        if (wide, tall) == (height, width):
            advice = "its rows and columns seem to be exchanged: transpose it"
        raise CaptureError(
            f"{path}: a {what} of {wide}x{tall} pixels for images of "
            f"{width}x{height}; {advice}"
        )
    row = ((np.arange(height) + 0.5) * tall / height).astype(int)
    column = ((np.arange(width) + 0.5) * wide / width).astype(int)
    return array[row[:, None], column]


def _depths(path, capture):
    if path.is_dir():
        paths, rows = _files(path, DEPTHS, capture, "depths")
        maps = [_depth_map(file) for file in paths]
    else:
        paths, maps = [path], _stack(path)
        rows = external_arrays.frames_of(len(maps), capture, path, "depths")
        paths = paths * len(rows)
    depths = np.full(capture.images.shape[:3], np.nan, np.float32)
    for where, depth_map, row in zip(paths, maps, rows, strict=True):
        positive = np.isfinite(depth_map) & (depth_map > 0)
        if not positive.any():
            raise CaptureError(
                f"{where}: no positive depth for frame {capture.ids[row]!r}; use the "
                "depth map as the tool wrote it"
            )
        depth = np.where(positive, depth_map, np.nan)
        depths[row] = _resample(depth, capture, where, "depth")
    return depths


def _depth_map(path):
    if path.suffix.lower() == ".npy":
        depth_map = npz_files.load_array(path, images.MAX_PIXELS).squeeze()
    elif path.suffix.lower() == ".exr":
        image = exr.in_display_window(path, exr.read_exr(path))
        depth_map = image.depth
        if depth_map is None and image.color is not None:
            depth_map = image.color[..., 0]
    else:
        depth_map = images.read_numbers(path)
    if depth_map is None or depth_map.ndim != 2:
        raise CaptureError(f"{path}: not a depth map; expected one channel")
    return depth_map.astype(np.float32)


def _stack(path):
    if path.suffix == ".npy":
        return _checked_stack(
            npz_files.load_array(path, external_arrays.MOST_NUMBERS), path, "it"
        )
    arrays = npz_files.load_arrays(path)
    name = "depths" if "depths" in arrays else next(iter(arrays), "depths")
    return _checked_stack(arrays.get(name, np.zeros(0)), path, name)


def _checked_stack(array, path, name):
    array = array[..., 0] if array.ndim == 4 and array.shape[3] == 1 else array
    if array.ndim != 3:
        raise CaptureError(
            f"{path}: {name} has shape {array.shape}; expected [frames, height, width]"
        )
    return array.astype(np.float32)


def _flow(path, capture):
    if path.is_dir():
        sides = {side: _flo_stack(path / side) for side in ("forward", "backward")}
    else:
        arrays = npz_files.load_arrays(path)
        absent = {"forward", "backward"} - set(arrays)
        if absent:
            raise CaptureError(
                f"{path}: no {sorted(absent)[0]!r} flow; both directions are needed "
                "for the consistency check"
            )
        sides = {side: arrays[side] for side in ("forward", "backward")}
    width, height = capture.size
    rows = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    expected_shape = (len(rows) - 1, height, width, 2)
    for side, array in sides.items():
        if array.shape != expected_shape or not np.isfinite(array).all():
            raise CaptureError(
                f"{path}: {side} flow of shape {array.shape}; expected "
                f"{expected_shape}, finite: between consecutive training frames in "
                "temporal order, in pixels of the images as they are read"
            )
    forward, backward = np.zeros((2, len(capture.ids), height, width, 2), np.float32)
    forward[rows[:-1]], backward[rows[1:]] = sides["forward"], sides["backward"]
    return {"forward": forward, "backward": backward}


def _flo_stack(folder):
    paths = _flo_files(folder)
    fields = [_flo(file) for file in paths]
    for path, field in zip(paths, fields, strict=True):
        if field.shape != fields[0].shape:
            (height, width), (tall, wide) = field.shape[:2], fields[0].shape[:2]
            raise CaptureError(
                f"{path}: {width}x{height} pixels, but {paths[0].name} has "
                f"{wide}x{tall}; all must have the size of the images as they are read"
            )
    return np.stack(fields)


def _flo_files(folder) -> Sequence[pathlib.Path]:
    files = sorted(folder.glob("*.flo"), key=lambda file: frames.natural(file.name))
    if not files:
        raise CaptureError(
            f"{folder}: no .flo file; both directions are needed, in the folders "
            "forward and backward"
        )
    return files


def _flo(path):
    """Read a Middlebury .flo file: magic number, width, height, and flow by pixel."""
    raw = safe_files.read_bytes(path, 12 + 8 * images.MAX_PIXELS)
    head = np.frombuffer(raw[:12].ljust(12, b"\0"), "<i4")
    width, height = int(head[1]), int(head[2])
    right_magic = np.frombuffer(raw[:4].ljust(4, b"\0"), "<f4")[0] == FLO_MAGIC
    if not right_magic or len(raw) != 12 + 8 * width * height:
        raise CaptureError(
            f"{path}: not a .flo file of {width}x{height} ({len(raw)} bytes); export "
            "it again"
        )
    return np.frombuffer(raw[12:], "<f4").reshape(height, width, 2)
