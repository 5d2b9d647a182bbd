"""Point tracks on the surfaces of a trained scene that are visible at one time."""

from typing import NamedTuple

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.json_files import AnyPath, refuse_existing, replaced_file
from nerfies_jax.capture.units import Units, places_in
from nerfies_jax.capture.world_points import pixels_of
from nerfies_jax.evaluation import model_flow
from nerfies_jax.evaluation.frames import spread, view_of
from nerfies_jax.evaluation.model_flow import Move
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.training.model import TrainState

MIN_ALPHA = 0.5  # of a pixel that shows a surface
# A point is visible if its depth exceeds the rendered depth by at most this share,
# because rendered depth is a mean over semi-transparent surfaces. In a video of a
# bookshelf after 250 steps of training, the rendered depth of a point differs from its
# own in the next frame by -1 % (lower quartile) to 14 % (upper quartile).
DEPTH_TOLERANCE = 0.1


class SurfaceTracks(NamedTuple):
    """Points over training frames in temporal order, in NumPy."""

    positions: np.ndarray  # [points, frames, 3] scene units, the start if not found
    visible: np.ndarray  # [points, frames] bool: found, in the image and not occluded
    times: np.ndarray  # [frames] in [0, 1]
    pixels: np.ndarray  # [points, frames, 2] in the image of the frame, right and down
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
      count: Largest number of points, evenly spaced over the image.
      frames: Number of frames, evenly spaced over the training frames. None for all.
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
    first_view = view_of(capture, start)
    rendering = draw(state, first_view)
    surface_depth = np.asarray(rendering.depth)
    surface = np.argwhere((rendering.alpha > MIN_ALPHA) & (surface_depth > 0))
    if not len(surface):
        raise ValueError(
            f"the model renders no surface at time={capture.times[start]:g} to select "
            "points on; choose another time, or train for more steps"
        )
    line, column = spread(surface, count).T
    pixels = np.stack([column, line], axis=1) + 0.5
    points = model_flow.surface(first_view.camera, pixels, surface_depth[line, column])
    positions, visible, track_pixels = [], [], []
    for row in rows.tolist():
        other_view = view_of(capture, row)
        end = move(state, points, first_view, other_view)
        rendering = draw(state, other_view)
        pixel, depth, inside = pixels_of(
            capture.cameras, row, end.points.astype(np.float32), capture.size
        )
        column, line = np.where(inside[:, None], pixel, 0).astype(int).T
        surface_depth = np.asarray(rendering.depth)
        in_front = depth <= surface_depth[line, column] * (1 + DEPTH_TOLERANCE)
        solid = rendering.alpha[line, column] > MIN_ALPHA
        positions.append(end.points)
        visible.append(end.converged & inside & solid & in_front)
        track_pixels.append(pixel)
    return SurfaceTracks(
        positions=np.stack(positions, axis=1).astype(np.float32),
        visible=np.stack(visible, axis=1),
        times=times,
        pixels=np.stack(track_pixels, axis=1).astype(np.float32),
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
    # World coordinates may be large: float32 resolves map coordinates to only 3 cm.
    positions = places_in(units, capture, tracks.positions)
    arrays["positions"] = positions.astype(np.float32 if units == "scene" else float)
    with replaced_file(path) as partial:
        np.savez_compressed(partial, **arrays)
