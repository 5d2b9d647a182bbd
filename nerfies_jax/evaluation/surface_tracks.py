"""Point tracks on the surfaces that a trained scene shows at one time."""

from typing import NamedTuple

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.frames import pixels_of
from nerfies_jax.capture.json_files import AnyPath, refuse_existing, replaced_file
from nerfies_jax.capture.units import Units, places_in
from nerfies_jax.evaluation import model_flow
from nerfies_jax.evaluation.frames import spread, view_of
from nerfies_jax.evaluation.model_flow import Move
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.training.model import TrainState

LEAST_ALPHA = 0.5  # below it a pixel shows no surface
# A point counts as seen up to this share of its depth behind what is drawn there: a
# drawn depth is a mean over what is soft. In a video of a bookshelf, 250 steps trained,
# the depth drawn of a point differs from one frame to the next by 1 % below to 14 %
# above its own, from the lower quartile to the upper.
DEPTH_SLACK = 0.1


class SurfaceTracks(NamedTuple):
    """Points over training frames in the order of time, in NumPy."""

    positions: np.ndarray  # [points, frames, 3] scene units; the start where lost
    # [points, frames] bool: followed, in the image, and not behind what is drawn
    visible: np.ndarray
    times: np.ndarray  # [frames] in [0, 1]
    pixels: np.ndarray  # [points, frames, 2] in that frame's image, right and down
    rows: np.ndarray  # [frames] of the capture


def follow(
    move: Move,
    draw: Draw,
    state: TrainState,
    capture: Capture,
    count: int,
    frames: int | None = None,
    time: float = 0.5,
) -> SurfaceTracks:
    """Track points on the rendered surface through all frames.

    Args:
      move: Motion of points.
      draw: Renderer.
      state: Trained state.
      capture: The capture.
      count: Largest number of points, evenly spread over the image.
      frames: Number of frames, evenly spread over the training frames. None for all.
      time: Time at which the points are selected, in the frame nearest to it.

    Returns:
      The tracks.

    Raises:
      ValueError: If nothing is rendered at `time`.
    """
    rows = capture.train[np.argsort(capture.times[capture.train], kind="stable")]
    rows = spread(rows, frames or len(rows))
    times = capture.times[rows]
    start = rows[np.argmin(np.abs(times - time))]
    here = view_of(capture, start)
    rendering = draw(state, here)
    surface_depth = np.asarray(rendering.depth)
    shown = np.argwhere((rendering.alpha > LEAST_ALPHA) & (surface_depth > 0))
    if not len(shown):
        raise ValueError(
            f"nothing is drawn at time {capture.times[start]:g} to pick points from; "
            "choose another, or train for longer"
        )
    line, column = spread(shown, count).T
    pixels = np.stack([column, line], axis=1) + 0.5
    points = model_flow.surface(here.camera, pixels, surface_depth[line, column])
    places, seen, projected = [], [], []
    for row in rows.tolist():
        there = view_of(capture, row)
        moved = move(state, points, here, there)
        rendering = draw(state, there)
        pixel, depth, inside = pixels_of(
            capture.cameras, row, moved.points.astype(np.float32), capture.size
        )
        column, line = np.where(inside[:, None], pixel, 0).astype(int).T
        surface_depth = np.asarray(rendering.depth)
        in_front = depth <= surface_depth[line, column] * (1 + DEPTH_SLACK)
        solid = rendering.alpha[line, column] > LEAST_ALPHA
        places.append(moved.points)
        seen.append(moved.found & inside & solid & in_front)
        projected.append(pixel)
    return SurfaceTracks(
        positions=np.stack(places, axis=1).astype(np.float32),
        visible=np.stack(seen, axis=1),
        times=times,
        pixels=np.stack(projected, axis=1).astype(np.float32),
        rows=rows,
    )


def write(
    path: AnyPath,
    tracks: SurfaceTracks,
    capture: Capture,
    units: Units = "scene",
    overwrite: bool = False,
) -> None:
    """Write tracks and the names of their frames as an .npz file, atomically.

    Args:
      path: The file.
      tracks: The tracks.
      capture: The capture.
      units: "scene" for scene units, "world" for those of the capture's own files.
      overwrite: True to replace an existing file.

    Raises:
      CaptureError: If the file exists or cannot be written.
    """
    refuse_existing(path, overwrite)
    arrays = tracks._asdict()
    rows = arrays.pop("rows")
    arrays["frames"] = np.array([capture.ids[row] for row in rows])
    # World coordinates may be large: float32 has meters of a map to 3 cm only.
    positions = places_in(units, capture, tracks.positions)
    arrays["positions"] = positions.astype(np.float32 if units == "scene" else float)
    with replaced_file(path) as partial:
        np.savez_compressed(partial, **arrays)
