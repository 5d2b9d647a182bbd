"""Optical flow between the frames of a capture."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

SIDES = ("forward", "backward")


class FrameFlow(NamedTuple):
    """Optical flow from each frame to the next and the previous one of the same camera.

    Flow leads from the center of a pixel to the position of the same surface point in
    the other frame, in pixels right and down. It is valid where both frames show the
    point. A frame without a neighbor refers to its own row and has no valid flow.
    Leaves are NumPy arrays in a capture and JAX arrays in training.
    """

    forward: Float[Array, "frames height width 2"]
    forward_valid: Bool[Array, "frames height width"]
    next_row: Int[Array, " frames"]
    backward: Float[Array, "frames height width 2"]
    backward_valid: Bool[Array, "frames height width"]
    previous_row: Int[Array, " frames"]


def sides(flow: FrameFlow):
    """Split flow into its two directions.

    Args:
      flow: The flow.

    Returns:
      Tuples (name, shift, seen, row of the neighbor) for "forward" and "backward".
    """
    return ((SIDES[0], *flow[:3]), (SIDES[1], *flow[3:]))


def validate(
    flow: FrameFlow, ids: Sequence[str], size: tuple[int, int], camera_ids: np.ndarray
) -> None:
    """Check flow against the capture that it belongs to.

    Args:
      flow: The flow, in NumPy.
      ids: Names of the frames.
      size: Width and height of the images in pixels.
      camera_ids: Physical camera of each frame, [frames].

    Raises:
      ValueError: If it is inconsistent, with the name of the frame.
    """
    count = len(ids)
    full_shape = (count, size[1], size[0])
    for name, shift, valid, rows in sides(flow):
        layouts = (
            (shift, np.float32, (*full_shape, 2)),
            (valid, np.bool_, full_shape),
        )
        for array, dtype, shape in layouts:
            if array.shape != shape or array.dtype != dtype:
                raise ValueError(
                    f"{name} flow is {array.dtype} of shape {array.shape}; expected "
                    f"{np.dtype(dtype)} of shape {shape}, as the images"
                )
        if rows.shape != (count,) or not np.issubdtype(rows.dtype, np.integer):
            raise ValueError(
                f"neighbors of {name} flow are {rows.dtype} of shape {rows.shape}; "
                f"expected one row number per frame, ({count},)"
            )
        bad = (rows < 0) | (rows >= count)
        if bad.any():
            row = int(np.argmax(bad))
            raise ValueError(
                f"{name} flow of frame {ids[row]!r} leads to row {rows[row]} of "
                f"{count}; write the frame's own row if it has no neighbor"
            )
        other = camera_ids[rows] != camera_ids
        if other.any():
            row = int(np.argmax(other))
            raise ValueError(
                f"{name} flow of frame {ids[row]!r} leads to {ids[rows[row]]!r} of "
                "another camera; flow is between frames of one camera"
            )
        bad = ~np.isfinite(shift).all((1, 2, 3))
        if bad.any():
            raise ValueError(
                f"{name} flow of frame {ids[int(np.argmax(bad))]!r} has NaN or "
                "infinite pixels; write 0 there and mark them as not seen"
            )
        alone = (rows == np.arange(count)) & valid.any((1, 2))
        if alone.any():
            raise ValueError(
                f"{name} flow of frame {ids[int(np.argmax(alone))]!r} is seen, but it "
                "leads to no other frame; mark its pixels as not seen"
            )


def take(flow: FrameFlow, rows: np.ndarray) -> FrameFlow:
    """Select frames of flow.

    Args:
      flow: The flow, in NumPy.
      rows: Indices of the frames, in the order of the result.

    Returns:
      The flow of these frames. A frame whose neighbor is not among them has no valid
      flow.
    """
    rows = np.asarray(rows, np.int64)
    new_index = np.full(len(flow.next_row), -1)
    new_index[rows] = np.arange(len(rows))
    leaves = []
    for _, shift, valid, neighbor in sides(flow):
        new_neighbor = new_index[neighbor[rows]]
        is_alone = new_neighbor < 0
        # A frame without a neighbor refers to its own row.
        new_neighbor = np.where(is_alone, np.arange(len(rows)), new_neighbor)
        shift, valid = shift[rows], valid[rows]  # copies, by indexing with an array
        shift[is_alone], valid[is_alone] = 0, False
        leaves += [shift, valid, new_neighbor.astype(np.int32)]
    return FrameFlow(*leaves)


def shrink(flow: FrameFlow, factor: int) -> FrameFlow:
    """Downscale flow by an integer factor.

    Args:
      flow: The flow, in NumPy.
      factor: Integer factor.

    Returns:
      The mean of each block, in pixels of the smaller images, valid where the whole
      block is. Incomplete blocks are cropped as those of images.
    """
    leaves = []
    for _, shift, valid, neighbor in sides(flow):
        pairs = [shrink_one(*pair, factor) for pair in zip(shift, valid, strict=True)]
        leaves += [np.stack(array) for array in zip(*pairs, strict=True)] + [neighbor]
    return FrameFlow(*leaves)


def shrink_one(
    shift: np.ndarray, valid: np.ndarray, factor: int
) -> tuple[np.ndarray, np.ndarray]:
    """Downscale the flow of one frame by an integer factor.

    Args:
      shift: Flow in pixels, [height, width, 2].
      valid: True where the flow is valid, [height, width].
      factor: Integer factor.

    Returns:
      The mean of each block in pixels of the smaller image, and True where the whole
      block is valid.
    """
    rows, columns = valid.shape[0] // factor, valid.shape[1] // factor
    crop = np.s_[: rows * factor, : columns * factor]
    blocks = (rows, factor, columns, factor)
    mean = shift[crop].reshape(*blocks, 2).mean((1, 3), dtype=np.float64)
    all_valid = np.all(valid[crop].reshape(blocks), axis=(1, 3))
    return (mean / factor).astype(np.float32), all_valid


def training_flow(capture) -> FrameFlow | None:
    """Return the flow between the training frames.

    Args:
      capture: The capture.

    Returns:
      The flow, None if the capture has none.
    """
    return None if capture.flow is None else take(capture.flow, capture.train)
