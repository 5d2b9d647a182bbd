"""Record of the preprocessing of a capture, and its file in the cache."""

import hashlib
import pathlib
from typing import Any, NamedTuple

import jax
import numpy as np

from nerfies_jax.capture import cache_files
from nerfies_jax.capture.capture import Capture, PointCloud
from nerfies_jax.capture.external import ExternalResults
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.paths import Paths
from nerfies_jax.preprocessing.rest_points import RestPoints
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.watch import Seconds

VERSION = 23


class Evidence(NamedTuple):
    """Preprocessing results of the training frames, in temporal order."""

    row: np.ndarray  # [frames] row of the capture
    flow: NeighborFlow
    moving: np.ndarray  # [frames, height, width] bool
    tracks: Tracks
    score: np.ndarray  # [tracks] in [0, 1], confidence that the point moves
    rest: RestPoints  # static point that explains each track best
    path_tracks: Tracks  # of the paths, aligned
    paths: Paths
    least_known: int  # minimum number of frames in which a usable path is known
    still: PointCloud  # dense static points
    unusable: str  # reason why tracking failed, or empty
    # True if masks or tracks are external, so that even few of them are trusted
    is_external: bool
    factor: int  # by which images were downsampled
    left_out: str  # parts skipped because of the budget, or empty
    # Median relative difference of external depth from static points, 0 without any
    depth_miss: float
    seconds: Seconds


# The fields that are records of arrays or numbers.
RECORDS: dict[str, type[NamedTuple]] = {
    "flow": NeighborFlow,
    "tracks": Tracks,
    "path_tracks": Tracks,
    "rest": RestPoints,
    "paths": Paths,
    "still": PointCloud,
    "seconds": Seconds,
}


def digest(capture: Capture, use_depths: bool = False, masks_only: bool = False) -> str:
    """Compute a digest of all inputs of `gather`.

    Args:
      capture: The capture.
      use_depths: As for `gather`.
      masks_only: As for `gather`.

    Returns:
      Hex digits.
    """
    checksum = hashlib.blake2b(digest_size=12)
    budget = capture.preprocessing
    options = f"{use_depths} {budget}{' masks only' * masks_only}"
    checksum.update(f"evidence {VERSION} {options}".encode())
    images = capture.images
    checksum.update(f"{images.dtype}{(len(capture.train), *images.shape[1:])}".encode())
    for row in capture.train:  # one at a time, because a copy of all may be large
        checksum.update(np.ascontiguousarray(images[row]).data)
    parts = [capture.times, capture.train]
    parts += [np.asarray([capture.near, capture.far])]
    parts += map(np.asarray, jax.tree.leaves(capture.cameras))
    if capture.points is not None:
        parts.append(capture.points.position)
    depths = capture.depths if use_depths else None
    external = () if capture.external is None else capture.external
    for name, part in zip(ExternalResults._fields, external, strict=False):
        checksum.update(f"{name} {part is None}".encode())
    parts += [part for part in (capture.valid, depths, *external) if part is not None]
    for part in parts:
        part = np.ascontiguousarray(part)
        checksum.update(f"{part.dtype}{part.shape}".encode())
        checksum.update(part.data)
    return checksum.hexdigest()


def save(path: pathlib.Path, evidence: Evidence) -> None:
    """Write a record into one file, atomically, with flow in half precision.

    Args:
      path: The file.
      evidence: The record.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, part in evidence._asdict().items():
        if name in RECORDS:
            arrays |= {f"{name}.{key}": value for key, value in part._asdict().items()}
        else:
            arrays[name] = np.asarray(part)
    for side in ("forward", "backward"):  # exact, because `gather` rounds to float16
        arrays[f"flow.{side}"] = arrays[f"flow.{side}"].astype(np.float16)
    cache_files.write_arrays(path, arrays, _identity(path))


def _identity(path):
    """Identity of a record, from the file name, which differs for each capture."""
    return f"evidence {VERSION} {path.stem}"


def load(path: pathlib.Path) -> Evidence:
    """Read a file written by `save` under the same name.

    Args:
      path: The file.

    Returns:
      The record.

    Raises:
      ValueError: If the content is anything else.
      OSError: If it cannot be read.
    """
    arrays = cache_files.read_arrays(path, _identity(path))
    parts: dict[str, Any] = {}
    for name in Evidence._fields:
        if name in RECORDS:
            fields = RECORDS[name]._fields
            leaves = (arrays[f"{name}.{key}"] for key in fields)
            parts[name] = RECORDS[name]._make(leaves)
        else:
            parts[name] = arrays[name]
    parts["seconds"] = Seconds(*(float(part) for part in parts["seconds"]))
    kinds_of_one = {
        "unusable": str,
        "left_out": str,
        "is_external": bool,
        "factor": int,
        "least_known": int,
        "depth_miss": float,
    }
    parts |= {name: kind(parts[name]) for name, kind in kinds_of_one.items()}
    flow = parts["flow"]
    parts["flow"] = flow._replace(
        forward=flow.forward.astype(np.float32),
        backward=flow.backward.astype(np.float32),
    )
    return Evidence(**parts)
