"""External tracks, masks, depth and flow in files, checked against a capture.

Each has as many frames as the capture, or as its training frames, in temporal order.
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
    pinholes,
    safe_files,
)
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.given import Given, GivenFiles

MOST_NUMBERS = 2_000_000_000  # of one file
# Names of the positions and visibilities of tracks, the axis of the frames if the shape
# is ambiguous, and the coordinate of the center of the first pixel: for TAPIR, whose
# images begin at 0, and for CoTracker, which aligns corners.
TRACK_NAMES = (
    ("tracks", "visibles", 1, 0.5),
    ("pred_tracks", "pred_visibility", 0, 0.0),
)
LEAST_INSIDE = 0.5  # minimum share of visible positions inside the images
SEEN = 0.5  # threshold of visibilities in [0, 1]
FLO_MAGIC = 202021.25  # of Middlebury's .flo
PICTURES, DEPTHS = (".png",), (".exr", ".png", ".npy")


@decoder.session()
def attached(capture: Capture, files: GivenFiles) -> Capture:
    """Read external files, except for times, and attach them to a capture.

    Args:
      capture: The capture.
      files: The files.

    Returns:
      The capture with `given` set.

    Raises:
      CaptureError: If a file does not fit.
    """
    if files == GivenFiles(times=files.times):  # times are read with the capture
        return capture
    if pinholes.has_lens(capture.cameras):
        raise CaptureError(
            f"{capture.path or capture.name}: files of other tools cannot be used for "
            "images with lens distortion; undistort the capture first, for example "
            "with image_undistorter of COLMAP"
        )
    parts: dict[str, Any] = {}
    notes = capture.notes
    if files.tracks is not None:
        parts |= _tracks(files.tracks, capture)
    if files.masks is not None:
        parts["moving"], more = _masks(files.masks, capture)
        notes += more
    if files.depths is not None:
        parts["depth"] = _depths(files.depths, capture)
    if files.flow is not None:
        parts |= _flow(files.flow, capture)
    return dataclasses.replace(capture, given=Given(capture.size, **parts), notes=notes)


def _rows(count, capture, path, what):
    """Return the rows of the capture that a number of frames refers to."""
    learned = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    every = np.argsort(capture.times, kind="stable")
    for rows in (learned, every):
        if count == len(rows):
            return rows
    raise CaptureError(
        f"{path}: {what} of {count} frames, but the capture has {len(every)} frames "
        f"({len(learned)} training frames); provide one for each, in temporal order"
    )


def _arrays(path):
    try:
        arrays = npz_files.read_arrays(path)
    except CaptureError:
        raise
    except ValueError as error:
        raise CaptureError(
            f"{path}: not a readable npz ({error}); save it with numpy.savez"
        ) from None
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub" or array.size > MOST_NUMBERS:
            raise CaptureError(
                f"{path}: {name} is {array.dtype} of shape {array.shape}; expected at "
                f"most {MOST_NUMBERS} numbers"
            )
    return arrays


def _tracks(path, capture):
    arrays = _arrays(path)
    for names in TRACK_NAMES:
        if names[0] in arrays and names[1] in arrays:
            break
    else:
        wanted = " or ".join(f"{one} and {two}" for one, two, *_ in TRACK_NAMES)
        raise CaptureError(
            f"{path}: holds {', '.join(arrays) or 'nothing'}; expected {wanted}"
        )
    pixel, seen = arrays[names[0]], arrays[names[1]]
    if pixel.ndim == 4 and len(pixel) == 1:  # CoTracker's batch
        pixel, seen = pixel[0], seen.reshape(seen.shape[1:])
    if pixel.ndim != 3 or pixel.shape[2] != 2 or seen.shape[:2] != pixel.shape[:2]:
        raise CaptureError(
            f"{path}: {names[0]} of shape {pixel.shape} and {names[1]} of "
            f"{seen.shape}; expected [tracks, frames, 2] and [tracks, frames], or "
            "frames first"
        )
    seen = seen.reshape(pixel.shape[:2])
    counts = {len(capture.train), len(capture.ids)}
    fits = [axis for axis in (0, 1) if pixel.shape[axis] in counts]
    if len(fits) != 1:
        fits = [names[2]]
    pixel, seen = np.moveaxis(pixel, fits[0], 0), np.moveaxis(seen, fits[0], 0)
    rows = _rows(len(pixel), capture, path, "tracks")
    pixel = pixel.astype(np.float32) + np.float32(0.5 - names[3])
    seen = (seen > SEEN) & np.isfinite(pixel).all(-1)
    if "size" in arrays:
        pixel = pixel * (np.asarray(capture.size) / arrays["size"]).astype(np.float32)
    inside = ((pixel > 0) & (pixel < np.asarray(capture.size))).all(-1)
    if not seen.any() or (inside & seen).sum() < LEAST_INSIDE * seen.sum():
        width, height = capture.size
        raise CaptureError(
            f"{path}: {(inside & seen).sum()} of {seen.sum()} visible positions are "
            f"inside the images of {width}x{height}, at least half must be; if images "
            "of another size were tracked, add their width and height as an array size"
        )
    seen &= inside
    pixels = np.zeros((len(capture.ids), pixel.shape[1], 2), np.float32)
    there = np.zeros(pixels.shape[:2], bool)
    pixels[rows], there[rows] = np.where(seen[..., None], pixel, 0), seen
    return {"track_pixel": pixels, "track_seen": there}


def _files(folder, suffixes, capture, what):
    """Return the files of a folder and their rows, by frame names or by number."""
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder of {what}; check the path")
    paths = [one for one in folder.iterdir() if one.suffix.lower() in suffixes]
    paths.sort(key=lambda one: frames.natural(one.name))
    by_name = {one.name.partition(".")[0]: one for one in paths}
    named = [row for row, name in enumerate(capture.ids) if name in by_name]
    if set(capture.train) <= set(named):
        return [by_name[capture.ids[row]] for row in named], np.array(named)
    if not paths:
        raise CaptureError(
            f"{folder}: contains no {what} ({' or '.join(suffixes)} files)"
        )
    return paths, _rows(len(paths), capture, folder, what)


def _masks(folder, capture):
    paths, rows = _files(folder, PICTURES, capture, "masks")
    moving = np.zeros(capture.images.shape[:3], bool)
    encoding = masks.find_encoding(paths)
    for path, row in zip(paths, rows, strict=True):
        mask = masks.read_mask(path, encoding)
        moving[row] = _fitted(mask, capture, path, "mask")
    share = moving[rows].mean()
    if share in (0, 1):
        raise CaptureError(
            f"{folder}: no {'white' if share == 0 else 'black'} pixel in any mask "
            f"({encoding.text}); moving objects must be white, and the rest black"
        )
    note = f"{len(paths)} masks of {encoding.text}; {share:.1%} white: moving"
    return moving, (note,)


def _fitted(array, capture, path, what):
    """Resample an array of the aspect of the images to their size (nearest pixel)."""
    width, height = capture.size
    tall, wide = array.shape[:2]
    # To within a pixel of the smaller of the two.
    if abs(wide * height - tall * width) > max(width, height, wide, tall):
        raise CaptureError(
            f"{path}: a {what} of {wide}x{tall} pixels for images of "
            f"{width}x{height}; their aspect ratios must match: export it uncropped"
        )
    row = ((np.arange(height) + 0.5) * tall / height).astype(int)
    column = ((np.arange(width) + 0.5) * wide / width).astype(int)
    return array[row[:, None], column]


def _depths(path, capture):
    if path.is_dir():
        paths, rows = _files(path, DEPTHS, capture, "depths")
        pictures = [_depth_picture(one) for one in paths]
    else:
        paths, pictures = [path], _stack(path)
        rows = _rows(len(pictures), capture, path, "depths")
        paths = paths * len(rows)
    depths = np.full(capture.images.shape[:3], np.nan, np.float32)
    for where, picture, row in zip(paths, pictures, rows, strict=True):
        known = np.isfinite(picture) & (picture > 0)
        if not known.any():
            raise CaptureError(
                f"{where}: no positive depth for frame {capture.ids[row]!r}; use the "
                "depth map as the tool wrote it"
            )
        depth = np.where(known, picture, np.nan)
        depths[row] = _fitted(depth, capture, where, "depth")
    return depths


def _depth_picture(path):
    if path.suffix.lower() == ".npy":
        picture = frames.load_array(path, images.MAX_PIXELS).squeeze()
    elif path.suffix.lower() == ".exr":
        stored = exr.in_display_window(path, exr.read_exr(path))
        picture = stored.depth
        if picture is None and stored.color is not None:
            picture = stored.color[..., 0]
    else:
        picture = images.read_numbers(path)
    if picture is None or picture.ndim != 2:
        raise CaptureError(f"{path}: not a depth map; expected one channel")
    return picture.astype(np.float32)


def _stack(path):
    if path.suffix == ".npy":
        return _checked_stack(frames.load_array(path, MOST_NUMBERS), path, "it")
    arrays = _arrays(path)
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
        arrays = _arrays(path)
        missing = {"forward", "backward"} - set(arrays)
        if missing:
            raise CaptureError(
                f"{path}: no {sorted(missing)[0]!r} flow; both directions are needed "
                "for the consistency check"
            )
        sides = {side: arrays[side] for side in ("forward", "backward")}
    width, height = capture.size
    learned = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    expected = (len(learned) - 1, height, width, 2)
    for side, array in sides.items():
        if array.shape != expected or not np.isfinite(array).all():
            raise CaptureError(
                f"{path}: {side} flow of shape {array.shape}; expected {expected}, "
                "finite: between consecutive training frames in temporal order, in "
                "pixels of the images as they are read"
            )
    forward, backward = np.zeros((2, len(capture.ids), height, width, 2), np.float32)
    forward[learned[:-1]], backward[learned[1:]] = sides["forward"], sides["backward"]
    return {"forward": forward, "backward": backward}


def _flo_stack(folder):
    paths = _flo_files(folder)
    pictures = [_flo(one) for one in paths]
    for path, picture in zip(paths, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            (height, width), (tall, wide) = picture.shape[:2], pictures[0].shape[:2]
            raise CaptureError(
                f"{path}: {width}x{height} pixels, but {paths[0].name} has "
                f"{wide}x{tall}; all must have the size of the images as they are read"
            )
    return np.stack(pictures)


def _flo_files(folder) -> Sequence[pathlib.Path]:
    files = sorted(folder.glob("*.flo"), key=lambda one: frames.natural(one.name))
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
