"""Optical flow of a trained scene, from its learned motion."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.frames import spread, view_of
from nerfies_jax.evaluation.scores import Scored
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training.model import (
    Rendering,
    TrainState,
    View,
    in_default_precision,
)

PIXELS = 500  # evaluated pixels of a frame, evenly spaced
FRAMES = 4


class Moved(NamedTuple):
    """Positions of points at another time, in NumPy."""

    points: np.ndarray  # [points, 3] scene units, the original ones if not found
    converged: np.ndarray  # [points] bool, False if the inverse warp did not converge


# (state, points [points, 3] in scene units, their view, target view) -> new positions
Move = Callable[[TrainState, np.ndarray, View, View], Moved]
# (spec, metadata, effects=()) -> None if the model does not move points
Mover = Callable[..., Move | None]


class Flow(NamedTuple):
    """Predicted and true flow of some pixels of some frames, in NumPy."""

    predicted: np.ndarray  # [pixels, 2], NaN without a prediction
    truth: np.ndarray  # [pixels, 2]
    moving: np.ndarray | None  # [pixels] bool, True for pixels of moving objects


def _pixel_flow(
    move: Move,
    state: TrainState,
    here: View,
    there: View,
    pixels: np.ndarray,
    depth: np.ndarray,
) -> np.ndarray:
    """Compute the flow of pixels from one view to another.

    The point at the depth of each pixel is moved and projected to the other view. The
    flow is NaN without depth, without the moved point, and behind the other camera.
    """
    valid = np.isfinite(depth) & (depth > 0)
    pixels = np.asarray(in_default_precision(pixels))
    points = surface(here.camera, pixels, np.where(valid, depth, 1))
    end = move(state, points, here, there)
    target, in_front = _project(there.camera, in_default_precision(end.points))
    valid = valid & end.converged & np.asarray(in_front)
    return np.where(valid[:, None], np.asarray(target) - pixels, np.nan)


def image_flow(
    move: Move, state: TrainState, here: View, there: View, rendering: Rendering
) -> np.ndarray:
    """Compute the flow of a whole rendered image to another view.

    Args:
      move: Motion of points.
      state: Trained state.
      here: View of the image.
      there: The other view.
      rendering: The rendered image.

    Returns:
      Flow in pixels [height, width, 2]. It is NaN if opacity is below one half or
      `_pixel_flow` has no result.
    """
    pixels = _pixels(rendering)
    depth = np.where(rendering.alpha > 0.5, np.asarray(rendering.depth), 0)
    flow = _pixel_flow(move, state, here, there, pixels, depth.ravel())
    return flow.reshape(*rendering.alpha.shape, 2)


def image_distance(
    move: Move, state: TrainState, here: View, there: View, rendering: Rendering
) -> np.ndarray:
    """Compute the distance that visible surfaces have moved between two times.

    Args:
      move: Motion of points.
      state: Trained state.
      here: View of the image.
      there: View with the other time.
      rendering: The rendered image.

    Returns:
      Distances in scene units [height, width]. They are NaN if opacity is below one
      half or the point is not found.
    """
    depth = np.asarray(rendering.depth).ravel()
    solid = np.asarray(rendering.alpha).ravel() > 0.5
    valid = solid & np.isfinite(depth) & (depth > 0)
    points = surface(here.camera, _pixels(rendering), np.where(valid, depth, 1))
    end = move(state, points, here, there)
    distance = np.linalg.norm(end.points - points, axis=1)
    distance = np.where(valid & end.converged, distance, np.nan)
    return distance.reshape(rendering.alpha.shape)


def _pixels(rendering):
    """Return the centers [height * width, 2] of the pixels, row by row."""
    height, width = rendering.alpha.shape
    column, line = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([column.ravel(), line.ravel()], axis=1)


def surface(camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Unproject pixels to z-depths.

    Args:
      camera: The camera.
      pixels: Pixel positions (x, y) with centers at +0.5, [pixels, 2].
      depth: z-depths in scene units, [pixels].

    Returns:
      Points in scene units, [pixels, 3].
    """
    return np.asarray(
        _surface(camera, in_default_precision(pixels), in_default_precision(depth))
    )


@jax.jit
def _surface(
    camera: Camera, pixels: Float[Array, "pixels 2"], depth: Float[Array, " pixels"]
) -> Float[Array, "pixels 3"]:
    ray = jax.vmap(lambda pixel: rays.pixel_ray(camera, pixel))(pixels)
    distance = rays.distance_of_depth(camera, ray.direction, depth)
    return jax.vmap(rays.point_at)(ray.origin, ray.direction, distance)


@jax.jit
def _project(
    camera: Camera, points: Float[Array, "pixels 3"]
) -> tuple[Float[Array, "pixels 2"], Bool[Array, " pixels"]]:
    pixel, depth = jax.vmap(lambda point: cameras.project(camera, point))(points)
    return pixel, depth > 0


def heldout_flow(
    move: Move, state: TrainState, capture: Capture, scored: Scored
) -> Flow | None:
    """Compute the flow of rendered frames to the next frame of their camera.

    At most `FRAMES` frames and `PIXELS` pixels of each are used, whose points are
    visible in both frames.

    Args:
      move: Motion of points.
      state: Trained state.
      capture: The capture, with its flow.
      scored: Rendered frames.

    Returns:
      Predicted and true flow. None if the capture has no flow for these frames.
    """
    if capture.flow is None:
        return None
    visible = capture.flow.forward_valid[scored.rows]
    places = np.flatnonzero(visible.any(axis=(1, 2)))
    if not len(places):
        return None
    predictions, truth, moving = [], [], []
    for place in spread(places, FRAMES):
        row = int(scored.rows[place])
        line, column = spread(np.argwhere(visible[place]), PIXELS).T
        predictions.append(
            _pixel_flow(
                move,
                state,
                view_of(capture, row),
                view_of(capture, int(capture.flow.next_row[row])),
                np.stack([column, line], axis=1) + 0.5,
                scored.depth[place, line, column],
            )
        )
        truth.append(capture.flow.forward[row, line, column])
        if capture.moving is not None:
            moving.append(capture.moving[row, line, column])
    return Flow(
        np.concatenate(predictions),
        np.concatenate(truth),
        np.concatenate(moving) if moving else None,
    )
