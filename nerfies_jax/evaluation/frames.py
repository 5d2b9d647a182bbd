"""Frames of a capture on the device, and views to render."""

from collections.abc import Set
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.capture import frame_memory
from nerfies_jax.capture.capture import Capture
from nerfies_jax.capture.flow import training_flow
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training import frame_stream
from nerfies_jax.training.frame_stream import FrameStream, TrainingFrames
from nerfies_jax.training.model import (
    Frames,
    Model,
    TrainState,
    View,
    in_default_precision,
)


def frames_of(capture: Capture, required_data: Set[str] = frozenset()) -> Frames:
    """Move the training frames of a capture to the device.

    Args:
      capture: The capture.
      required_data: Names of additional data to include if the capture has it:
        "depths", "points", "flow", "moving".

    Returns:
      The frames.

    Raises:
      ValueError: If they do not fit in the memory of the device.
    """
    rows, is_shared = capture.train, frame_memory.is_shared(capture)
    pixels = _pixels(capture, required_data)
    if not is_shared:
        pixels = {name: array[rows] for name, array in pixels.items()}
    frame_memory.check_device(sum(array.nbytes for array in pixels.values()))
    frames = _without_pixels(capture, required_data)
    if is_shared:
        # Unlike `jnp.asarray`, this does not copy the arrays.
        pixels = jax.device_put(pixels)
        frames = frames._replace(image_rows=rows.astype(np.int32))
    return in_default_precision(frames._replace(**pixels))


def training_frames(
    model: Model, capture: Capture, training: int = 0
) -> TrainingFrames:
    """Move the training frames of a capture to the device, or stream them to it.

    They are streamed if they do not fit in `frame_memory.device_limit`.

    Args:
      model: The model that is trained.
      capture: The capture.
      training: Bytes that training needs on the device in addition to the frames.

    Returns:
      The frames, or their stream.

    Raises:
      ValueError: If they do not fit and `model` cannot be trained on a stream, or if
        not even the frames of a few steps fit.
    """
    if not _is_streamed(model, capture, training):
        return frames_of(capture, model.required_data)
    return FrameStream(model, *_stream_inputs(model, capture, training))


def check_frames(model: Model, capture: Capture, training: int = 0) -> None:
    """Check that `training_frames` can succeed, without moving any frames.

    Args:
      model: The model that is trained.
      capture: The capture.
      training: Bytes that training needs on the device in addition to the frames.

    Raises:
      ValueError: If it cannot.
    """
    if _is_streamed(model, capture, training):
        frames, pixels, _, limit = _stream_inputs(model, capture, training)
        frame_stream.check_memory(model, frames, pixels, limit)


def _is_streamed(model, capture, training) -> bool:
    is_shared = frame_memory.is_shared(capture)
    count = len(capture.images) if is_shared else len(capture.train)
    pixels = _pixels(capture, model.required_data)
    frame_bytes = sum(count * array[:1].nbytes for array in pixels.values())
    if model.reads is None:
        frame_memory.check_device(frame_bytes)
    return model.reads is not None and frame_bytes > frame_memory.device_limit(training)


def _stream_inputs(model, capture, training):
    """Return the arguments of a stream after the model."""
    frames = _without_pixels(capture, model.required_data)
    pixels = _pixels(capture, model.required_data)
    return frames, pixels, capture.train, frame_memory.device_limit(training)


def _pixels(capture, required_data) -> dict[str, Any]:
    """Return the images, masks and depths of all frames that a model reads."""
    names = ("images", "valid", *sorted(required_data & {"depths", "moving"}))
    arrays = {name: getattr(capture, name) for name in names}
    return {name: array for name, array in arrays.items() if array is not None}


def _without_pixels(capture, required_data) -> Frames:
    """Return the training frames without images and masks, in NumPy."""
    rows, data = capture.train, {}
    if "points" in required_data and capture.points is not None:
        data["points"] = capture.points.position
    if "flow" in required_data and capture.flow is not None:
        data["flow"] = training_flow(capture)
    images = capture.images
    return Frames(
        images=np.zeros((0, *images.shape[1:]), images.dtype),
        cameras=cameras.take(capture.cameras, rows),
        times=capture.times[rows],
        appearance=capture.appearance_ids[rows],
        valid=None,
        **data,
    )


def with_refined_cameras(model: Model, state: TrainState, capture: Capture) -> Capture:
    """Replace the cameras of a capture by the refined cameras of a model.

    Args:
      model: The model.
      state: Trained state.
      capture: A capture of the same frames, with or without lens distortion.

    Returns:
      The capture, unchanged if the model does not refine cameras.
    """
    if model.apply_to_capture is None:
        return capture
    return model.apply_to_capture(state.params, capture)


def view_of(capture: Capture, row: int | np.integer) -> View:
    """Return the view of a frame.

    Args:
      capture: The capture.
      row: Index of the frame.

    Returns:
      Camera, time and appearance id of the frame, on the device.
    """
    view = View(
        cameras.take(capture.cameras, row),
        capture.times[row],
        capture.appearance_ids[row],
    )
    return in_default_precision(view)


def resized(view: View, old: tuple[int, int], new: tuple[int, int]) -> View:
    """Adapt a view to another image size.

    Args:
      view: The view.
      old: Width and height of its image in pixels.
      new: New width and height in pixels.

    Returns:
      The view with its camera adapted.
    """
    if old == new:
        return view
    return view._replace(camera=cameras.resize(view.camera, old, new))


def path_views(path: Camera, times: np.ndarray, like: View) -> list[View]:
    """Return the views along a camera path.

    Args:
      path: Cameras, [frames].
      times: Times in [0, 1], [frames].
      like: View whose appearance is used.

    Returns:
      One view for each time.
    """
    return [
        like._replace(
            camera=in_default_precision(cameras.take(path, row)),
            time=jnp.asarray(time, like.time.dtype),
        )
        for row, time in enumerate(times)
    ]


def spread(rows: np.ndarray, most: int) -> np.ndarray:
    """Select evenly spaced rows, in their order.

    Args:
      rows: Rows, [rows, ...].
      most: Largest number to select.

    Returns:
      The selected rows.
    """
    indices = np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)
    return rows[indices]
