"""Point tracks in files of TAPIR, BootsTAPIR, CoTracker, LocoTrack and their users."""

import pathlib
from typing import NamedTuple

import numpy as np
import scipy.special

from nerfies_jax.capture import frames, npz_files
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.preprocessing import external_arrays

# Names of positions, the axis of the frames if the shape is ambiguous, and the
# coordinate of the center of the first pixel: images of TAPIR and LocoTrack begin at 0,
# and CoTracker aligns the centers of corner pixels.
POSITIONS = {"tracks": (1, 0.5), "pred_tracks": (0, 0.0)}
# Names of visibilities in [0, 1] or booleans.
VISIBLE = (
    *("visibles", "visibility", "visibilities", "visible"),
    *("pred_visibility", "pred_visibilities", "pred_visibles"),
)
# Names of occlusion: booleans, probabilities, or logits if any is outside of [0, 1].
OCCLUDED = ("occluded", "occlusion", "occlusions", "pred_occlusion")
UNCERTAIN = "expected_dist"  # logit that a position is off by several pixels
SEEN = 0.5  # threshold of visibilities
LEAST_INSIDE = 0.5  # minimum share of visible positions inside the images
MOST_PLACES = 30_000_000  # tracks times frames. More tracks are subsampled.
PAIR_COLUMNS = 4  # x, y, occlusion logit and uncertainty logit
EXAMPLE = "numpy.savez(FILE, tracks=tracks, visibles=visibles)"


class TrackFile(NamedTuple):
    """Tracks of a file, in the order and units of the file."""

    pixel: np.ndarray  # [tracks, frames, 2] or frames first
    visible: np.ndarray  # [tracks, frames] bool, or frames first
    frames_axis: int  # the more likely axis of the frames
    center: float  # coordinate of the center of the first pixel
    size: np.ndarray | None  # width and height of the tracked images, if known


def read(path: pathlib.Path, capture: Capture) -> dict[str, np.ndarray]:
    """Read tracks, and convert them to the pixels and frames of a capture.

    Args:
      path: An npz, a folder of npy files with the same names, or the folder of pairs
        QUERY_TARGET.npy that Shape of Motion stores.
      capture: The capture.

    Returns:
      `track_pixel` [frames, tracks, 2] with pixel centers at +0.5, and `track_seen`
      [frames, tracks].

    Raises:
      CaptureError: If the file does not fit.
    """
    pairs = _pairs(path) if path.is_dir() else None
    if pairs is None:
        pairs = _select_arrays(_arrays(path), path)
    counts = {len(capture.train), len(capture.ids)}
    pixel, visible = pairs.pixel, pairs.visible
    fits = [axis for axis in (0, 1) if pixel.shape[axis] in counts]
    if len(fits) != 1:
        fits = [pairs.frames_axis]
    pixel, visible = np.moveaxis(pixel, fits[0], 0), np.moveaxis(visible, fits[0], 0)
    rows = external_arrays.frames_of(len(pixel), capture, path, "tracks")
    stride = -(-pixel[..., 0].size // MOST_PLACES) or 1
    pixel, visible = pixel[:, ::stride], visible[:, ::stride]
    pixel = pixel.astype(np.float32) + np.float32(0.5 - pairs.center)
    visible = visible & np.isfinite(pixel).all(-1)
    if pairs.size is not None:
        pixel = pixel * (np.asarray(capture.size) / pairs.size).astype(np.float32)
    visible &= _inside(pixel, visible, capture.size, path)
    pixels = np.zeros((len(capture.ids), pixel.shape[1], 2), np.float32)
    track_seen = np.zeros(pixels.shape[:2], bool)
    pixels[rows], track_seen[rows] = np.where(visible[..., None], pixel, 0), visible
    return {"track_pixel": pixels, "track_seen": track_seen}


def _inside(pixel, visible, size, path):
    """Find the positions inside the images, which most visible ones must be."""

    def count(position):
        with np.errstate(invalid="ignore"):
            inside = ((position > 0) & (position < np.asarray(size))).all(-1)
        return inside, (inside & visible).sum()

    inside, number = count(pixel)
    if visible.any() and number >= LEAST_INSIDE * visible.sum():
        return inside
    advice = (
        "if images of another size were tracked, add their width and height as an "
        "array size"
    )
    if visible.any() and count(pixel[..., ::-1])[1] >= LEAST_INSIDE * visible.sum():
        advice = "their axes seem to be exchanged: store x (right) before y (down)"
    width, height = size
    raise CaptureError(
        f"{path}: {number} of {visible.sum()} visible positions are inside the images "
        f"of {width}x{height}, at least half must be; {advice}"
    )


def _arrays(path):
    """Load the arrays of an npz, or of a folder of npy files, by their names."""
    if path.is_dir():
        arrays = {}
        names = (*POSITIONS, *VISIBLE, *OCCLUDED, UNCERTAIN, "size")
        # The longest first: clip_pred_tracks.npy is not tracks.
        names = sorted(names, key=len, reverse=True)
        for file in sorted(path.glob("*.npy")):
            stem = file.stem
            name = next((n for n in names if stem == n or stem.endswith(f"_{n}")), None)
            if name is not None:
                arrays[name] = npz_files.load_array(
                    file, external_arrays.MOST_NUMBERS, "fiub"
                )
        return arrays
    if path.suffix.lower() not in (".npz", ""):
        raise CaptureError(
            f"{path}: tracks are read from npz files, not from {path.suffix} files; "
            f"save them with {EXAMPLE}"
        )
    return npz_files.load_arrays(path)


def _select_arrays(arrays, path):
    name = next((name for name in POSITIONS if name in arrays), None)
    visibility = next((n for n in (*VISIBLE, *OCCLUDED) if n in arrays), None)
    if name is None or visibility is None:
        raise CaptureError(
            f"{path}: contains {', '.join(arrays) or 'nothing'}; expected "
            f"{' or '.join(POSITIONS)}, and {VISIBLE[0]}, pred_visibility or "
            f"occlusion; save them with {EXAMPLE}"
        )
    pixel, flag = arrays[name], arrays[visibility]
    parts = {visibility: flag}
    if UNCERTAIN in arrays and visibility in OCCLUDED:
        parts[UNCERTAIN] = arrays[UNCERTAIN]
    if pixel.ndim == 4 and len(pixel) == 1:  # a batch of one
        pixel = pixel[0]
        parts = {
            key: part[0] if part.ndim >= 3 and len(part) == 1 else part
            for key, part in parts.items()
        }
    for key, part in parts.items():
        if part.ndim == 3 and part.shape[2] == 1:
            parts[key] = part = part[..., 0]
        if pixel.ndim != 3 or pixel.shape[2] != 2 or part.shape != pixel.shape[:2]:
            raise CaptureError(
                f"{path}: {name} of shape {pixel.shape} and {key} of {part.shape}; "
                "expected [tracks, frames, 2] and [tracks, frames], or frames first"
            )
    visible = parts[visibility] > SEEN
    if visibility in OCCLUDED:
        visible = _visible(parts[visibility], parts.get(UNCERTAIN))
    axis, center = POSITIONS[name]
    return TrackFile(pixel, visible, axis, center, _size(arrays.get("size"), path))


def _size(size, path):
    if size is None:
        return None
    if size.shape != (2,) or not (np.isfinite(size) & (size >= 1)).all():
        raise CaptureError(
            f"{path}: size is {size.tolist()}; expected the width and the height of "
            "the tracked images in pixels"
        )
    return size


def _visible(occlusion, uncertain=None):
    """Compute visibility as TAPIR does from the logits of occlusion and uncertainty."""
    occlusion = np.asarray(occlusion, np.float32)
    is_logit = bool(((occlusion < 0) | (occlusion > 1)).any())
    if not is_logit:
        return occlusion <= SEEN
    visible = scipy.special.expit(-occlusion)
    if uncertain is not None:
        visible = visible * scipy.special.expit(-np.asarray(uncertain, np.float32))
    return visible > SEEN


def _pairs(folder):
    """Read files QUERY_TARGET.npy, each with the points of one query frame."""
    files = {}
    for file in folder.glob("*.npy"):
        middle = len(file.stem) // 2  # both names have the same length
        if file.stem[middle : middle + 1] == "_" and len(file.stem) % 2:
            files[file.stem[:middle], file.stem[middle + 1 :]] = file
    targets = sorted({target for _, target in files}, key=frames.natural)
    queries = sorted({query for query, _ in files}, key=frames.natural)
    if not set(queries) <= set(targets):
        return None
    absent = [(q, t) for q in queries for t in targets if (q, t) not in files]
    if absent:
        name = "_".join(absent[0])
        raise CaptureError(
            f"{folder}: no {name}.npy ({len(absent)} of "
            f"{len(queries) * len(targets)} pairs of frames are missing); run the "
            "tracker again until it completes"
        )
    if not files:
        return None
    parts = []
    for query in queries:
        of_query = [files[query, target] for target in targets]
        tables = [_pair(file) for file in of_query]
        for file, table in zip(of_query, tables, strict=True):
            if table.shape != tables[0].shape:
                raise CaptureError(
                    f"{file}: {len(table)} points, but {of_query[0].name} has "
                    f"{len(tables[0])}; all files of a query frame must have the same"
                )
        stride = len(tables[0]) * len(targets) * len(queries) // MOST_PLACES + 1
        parts.append(np.stack([table[::stride] for table in tables]))
    table = np.concatenate(parts, axis=1)
    visible = _visible(table[..., 2], table[..., 3])
    return TrackFile(table[..., :2], visible, 0, 0.5, None)


def _pair(file):
    table = npz_files.load_array(file, external_arrays.MOST_NUMBERS)
    if table.ndim != 2 or table.shape[1] != PAIR_COLUMNS:
        raise CaptureError(
            f"{file}: an array of shape {table.shape}; expected [points, "
            f"{PAIR_COLUMNS}]: x, y, occlusion and expected_dist"
        )
    return table
