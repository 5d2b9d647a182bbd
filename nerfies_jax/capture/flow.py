"""Optical flow between the frames of a capture."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

SIDES = ("forward", "backward")


class FrameFlow(NamedTuple):
    """Flow from each frame to the next and the previous one of the same camera.

    From the center of a pixel to where what it shows lies in the other frame, in pixels
    right and down; `seen` where both frames show it. A frame without a neighbor names
    its own row, and nothing is seen. NumPy leaves in a capture, JAX in training.
    """

    forward: Float[Array, "frames height width 2"]
    forward_seen: Bool[Array, "frames height width"]
    next_row: Int[Array, " frames"]
    backward: Float[Array, "frames height width 2"]
    backward_seen: Bool[Array, "frames height width"]
    previous_row: Int[Array, " frames"]


def sides(flow: FrameFlow):
    """("forward", shift, seen, row of the neighbor), and the same backward."""
    return ((SIDES[0], *flow[:3]), (SIDES[1], *flow[3:]))


def validate(
    flow: FrameFlow, ids: Sequence[str], size: tuple[int, int], camera_ids: np.ndarray
) -> None:
    """Raise ValueError, naming frame and remedy, for what cannot be used."""
    count = len(ids)
    pictures = (count, size[1], size[0])
    for name, shift, seen, rows in sides(flow):
        expected = ((shift, np.float32, (*pictures, 2)), (seen, np.bool_, pictures))
        for array, kind, shape in expected:
            if array.shape != shape or array.dtype != kind:
                raise ValueError(
                    f"{name} flow is {array.dtype} of shape {array.shape}; expected "
                    f"{np.dtype(kind)} of shape {shape}, as the images"
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
                f"{count}; write the frame's own row where there is none"
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
        alone = (rows == np.arange(count)) & seen.any((1, 2))
        if alone.any():
            raise ValueError(
                f"{name} flow of frame {ids[int(np.argmax(alone))]!r} is seen, but it "
                "leads to no other frame; mark its pixels as not seen"
            )


def take(flow: FrameFlow, rows: np.ndarray) -> FrameFlow:
    """Some of the frames, in this order; who loses its neighbor sees none of it."""
    rows = np.asarray(rows, np.int64)
    place = np.full(len(flow.next_row), -1)
    place[rows] = np.arange(len(rows))
    taken = []
    for _, shift, seen, neighbor in sides(flow):
        moved = place[neighbor[rows]]
        lost = moved < 0
        there = np.where(lost, np.arange(len(rows)), moved).astype(np.int32)
        shift, seen = shift[rows], seen[rows]  # copies: rows are a list
        shift[lost], seen[lost] = 0, False
        taken += [shift, seen, there]
    return FrameFlow(*taken)


def shrink(flow: FrameFlow, factor: int) -> FrameFlow:
    """Flow of pictures smaller by an integer factor, in their own larger pixels.

    The mean of each block, seen where all of it is; trimmed as the pictures are.
    """
    shrunk = []
    for _, shift, seen, neighbor in sides(flow):
        both = [shrink_one(*one, factor) for one in zip(shift, seen, strict=True)]
        shrunk += [np.stack(array) for array in zip(*both, strict=True)] + [neighbor]
    return FrameFlow(*shrunk)


def shrink_one(
    shift: np.ndarray, seen: np.ndarray, factor: int
) -> tuple[np.ndarray, np.ndarray]:
    """`shrink` of one frame: [height, width, 2] pixels and where they are seen."""
    lines, columns = seen.shape[0] // factor, seen.shape[1] // factor
    trimmed = np.s_[: lines * factor, : columns * factor]
    parts = (lines, factor, columns, factor)
    mean = shift[trimmed].reshape(*parts, 2).mean((1, 3), dtype=np.float64)
    whole = seen[trimmed].reshape(parts).all((1, 3))
    return (mean / factor).astype(np.float32), whole


def training_flow(capture) -> FrameFlow | None:
    """Select the flow of the training frames; None if the capture has none."""
    return None if capture.flow is None else take(capture.flow, capture.train)
