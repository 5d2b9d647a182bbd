"""Optical flow files in a Nerfies directory, an extension of this library."""

import pathlib
from collections.abc import Sequence

import numpy as np

from nerfies_jax.capture import flow as flows
from nerfies_jax.capture import images, npz_files
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.capture.json_files import read_json, write_json

NEIGHBORS = "neighbors.json"  # {"forward": {id: id of the next frame}, "backward": ...}


def write(flow: FrameFlow, ids: Sequence[str], folder: pathlib.Path, factor: int):
    """Write flow at one reduction into the folder `flow` of a capture.

    `<factor>x/forward/ID.npy` is float32 [height, width, 3]: right and down in pixels
    of that reduction, and 1 where valid. Frames without a neighbor have no file.

    Args:
      flow: The flow at full size, in NumPy.
      ids: Names of the frames.
      folder: The folder `flow`.
      factor: Integer reduction.
    """
    neighbors = {}
    for name, shift, valid, rows in flows.sides(flows.shrink(flow, factor)):
        target = folder / f"{factor}x" / name
        target.mkdir(parents=True, exist_ok=True)
        pair_rows = np.flatnonzero(rows != np.arange(len(rows))).tolist()
        neighbors[name] = {ids[row]: ids[rows[row]] for row in pair_rows}
        for row in pair_rows:
            array = np.concatenate([shift[row], valid[row, ..., None]], axis=-1)
            array = array.astype(np.float32)
            np.save(target / f"{ids[row]}.npy", array, allow_pickle=False)
    write_json(folder / NEIGHBORS, neighbors)


def read(
    folder: pathlib.Path,
    source: int,
    shrink_by: int,
    ids: Sequence[str],
    size: tuple[int, int],
) -> FrameFlow | None:
    """Read flow written by `write`.

    Args:
      folder: The folder `flow`.
      source: Stored reduction to read.
      shrink_by: Integer factor by which the stored flow is reduced further.
      ids: Names of the frames. Neighbors that are not among them are ignored.
      size: Width and height of the reduced images in pixels.

    Returns:
      The flow, None if the folder has none.
    """
    if not (folder / NEIGHBORS).is_file():
        return None
    neighbors = read_json(folder / NEIGHBORS, dict[str, dict[str, str]])
    row_of = {name: row for row, name in enumerate(ids)}
    width, height = size
    leaves = []
    for side in flows.SIDES:
        shift = np.zeros((len(ids), height, width, 2), np.float32)
        valid = np.zeros((len(ids), height, width), bool)
        rows = np.arange(len(ids), dtype=np.int32)
        for row, name in enumerate(ids):
            neighbor = row_of.get(neighbors.get(side, {}).get(name))
            file = folder / f"{source}x" / side / f"{name}.npy"
            if neighbor is None or not file.is_file():
                continue
            shift[row], valid[row] = _read_frame(file, shrink_by, size)
            rows[row] = neighbor
        leaves += [shift, valid, rows]
    return FrameFlow._make(leaves)


def _read_frame(file, shrink_by, size):
    array = npz_files.load_array(file, 3 * images.MAX_PIXELS)
    width, height = size
    fits = array.ndim == 3 and array.shape[2] == 3
    if not fits or (
        array.shape[0] // shrink_by != height or array.shape[1] // shrink_by != width
    ):
        raise CaptureError(
            f"{file}: flow of shape {array.shape}; expected right, down and validity "
            f"for images of {width * shrink_by}x{height * shrink_by}, "
            f"[{height * shrink_by}, {width * shrink_by}, 3]"
        )
    shift, valid = array[..., :2].astype(np.float32), array[..., 2] > 0.5
    return flows.shrink_one(shift, valid, shrink_by)
