"""Training frames that do not fit on the device, and are streamed to it in windows.

The pixels that a step reads are a function of the run's key and the number of the step
(`Model.reads`), so results do not depend on the place of the frames. A window of steps
is on the device while a background thread gathers the next one from host memory.
"""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from nerfies_jax.capture import frame_memory
from nerfies_jax.runtime import data_parallel
from nerfies_jax.training.model import (
    Frames,
    Model,
    StepPixels,
    TrainState,
    in_default_precision,
)

STEPS = 10  # of a window
WINDOWS = 2  # on the device: that of the current steps and the next one


class Window(NamedTuple):
    """Frames on the device, from the first step that may read them."""

    run: bytes  # data of its key
    first: int
    frames: Future[Frames]

    def covers(self, run: bytes, step: int, steps: int) -> bool:
        """Test if the window has the pixels of a number of steps.

        Args:
          run: Data of the run's key.
          step: Number of completed steps.
          steps: Number of steps.

        Returns:
          True if it has.
        """
        last = self.first + STEPS - steps
        return self.run == run and self.first <= step <= last


class FrameStream:
    """Training frames in host memory, with windows of them on the devices of a model.

    Events receive `frames`, the training frames without pixels.

    Args:
      model: A model with `reads`.
      frames: The training frames without pixels: `images` has the shape of an image,
        but no rows.
      pixels: Arrays "images", "valid", "depths" and "moving" of the capture, [frames,
        height, width, ...] each, in host memory or mapped from a file.
      rows: Rows of the training frames in these arrays, [frames].
      limit: Bytes of device memory for frames.

    Raises:
      ValueError: If two windows need more.
    """

    def __init__(
        self,
        model: Model,
        frames: Frames,
        pixels: Mapping[str, np.ndarray],
        rows: np.ndarray,
        limit: float | int,
    ):
        self._devices, self._rows, self._pixels = model.devices, rows, pixels
        self.frames = in_default_precision(frames)
        self._resident = data_parallel.shared(self.frames, self._devices)
        check_memory(model, frames, pixels, limit)
        self._indices_of = _reader(model, self.frames)
        example = jax.eval_shape(self._indices_of, jax.random.key(0), np.int32(0))
        self._whole = len(example) == 1
        self._slots = min(example[0].size, len(rows))
        first = self._load(0, [np.zeros(x.shape, np.int32) for x in example])
        # Shapes of the frames that a step gets, with their devices.
        self.layout = jax.tree.map(abstract, first)
        self._thread = ThreadPoolExecutor(1, "frames")
        self._windows: list[Window] = []

    def window(self, state: TrainState, steps: int, more: int = STEPS) -> Frames:
        """Return the frames for the next steps, and begin to load those after them.

        Args:
          state: Training state before the steps.
          steps: Number of steps, at most `STEPS`.
          more: Number of steps until others than the following ones may be needed,
            these steps included.

        Returns:
          The frames on the devices of the model.
        """
        step, data = int(state.step), np.asarray(jax.random.key_data(state.key))
        # On one device, also if the state is on several.
        impl = jax.random.key_impl(state.key)
        key = jax.random.wrap_key_data(jnp.asarray(data), impl=impl)
        run = data.tobytes()
        while self._windows and not self._windows[0].covers(run, step, steps):
            self._windows.pop(0).frames.result()  # before more memory is used
        if not self._windows:
            self._begin(key, run, step)
        if len(self._windows) < WINDOWS:
            self._begin(key, run, step + min(STEPS, more))
        return self._windows[0].frames.result()

    def _begin(self, key, run, step):
        # Not in the thread: the device would compute it after steps that have begun.
        indices = jax.device_get(self._indices_of(key, np.int32(step)))
        frames = self._thread.submit(self._load, step, indices)
        self._windows.append(Window(run, step, frames))

    def _load(self, step, indices):
        """Gather the pixels of a window, and copy them to the devices."""
        if self._whole:
            rows = np.unique(indices[0])
            pixels: dict[str, Any] = {
                name: _copy_rows(array, self._rows[rows], self._slots)
                for name, array in self._pixels.items()
            }
            image_rows = np.zeros(len(self._rows), np.int32)
            image_rows[rows] = np.arange(len(rows))
            pixels["image_rows"] = image_rows
        else:
            row, *place = indices
            at = (self._rows[row], *place)
            read = {name: array[at] for name, array in self._pixels.items()}
            first = np.asarray(step, np.int32)
            step_pixels = StepPixels(first, read["images"], read.get("valid"))
            pixels = {"step_pixels": step_pixels}
        on_device = data_parallel.shared(in_default_precision(pixels), self._devices)
        return self._resident._replace(**jax.block_until_ready(on_device))


def check_memory(
    model: Model,
    frames: Frames,
    pixels: Mapping[str, np.ndarray],
    limit: float | int,
) -> None:
    """Check that the windows of a stream fit on the device.

    Args:
      model: As of `FrameStream`.
      frames: As of `FrameStream`.
      pixels: As of `FrameStream`.
      limit: As of `FrameStream`.

    Raises:
      ValueError: If they do not fit.
    """
    reader = _reader(model, frames._replace(times=jnp.asarray(frames.times)))
    reads = jax.eval_shape(reader, jax.random.key(0), np.int32(0))
    height, width = frames.images.shape[1:3]
    images: float = min(reads[0].size, len(frames.times))
    if len(reads) > 1:  # single pixels
        images = reads[0].size / (height * width)
    window = images * sum(array.nbytes // len(array) for array in pixels.values())
    always = sum(leaf.nbytes for leaf in jax.tree.leaves(frames))
    total = always + WINDOWS * window
    if total > limit:
        raise ValueError(
            f"frame_memory={limit / 2**30:.3g}: {total / 2**30:.3g} GiB of device "
            f"memory are needed for the frames of {WINDOWS * STEPS} steps, and for "
            "flow and points; increase it, read smaller images with max_side=..., or "
            "use fewer views per step"
        )


def _reader(model, frames):
    """Return a program of the key and a step, for what the next `STEPS` steps read."""

    @jax.jit
    def indices_of(key, step):
        def of_step(index):
            return model.reads(key, step + index, frames)

        return lax.map(of_step, np.arange(STEPS, dtype=np.int32))

    return indices_of


def _copy_rows(array, rows, count):
    """Copy rows of an array to memory that JAX on the CPU uses without another copy."""
    copy = frame_memory.allocate((count, *array.shape[1:]), array.dtype)
    np.take(array, rows, axis=0, out=copy[: len(rows)], mode="clip")
    return copy


def abstract(leaf: Any) -> jax.ShapeDtypeStruct:
    """Return the shape, dtype and devices of an array.

    Args:
      leaf: A JAX array, or a result of this function.

    Returns:
      The description.
    """
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)


TrainingFrames = Frames | FrameStream


def replicate(frames: TrainingFrames, devices: int) -> tuple[Frames, TrainingFrames]:
    """Replicate training frames to the devices of a model, unless they are streamed.

    Args:
      frames: The frames.
      devices: Number of devices.

    Returns:
      The frames on the first device, without pixels if they are streamed, and those on
      each of the devices, or the stream.
    """
    if isinstance(frames, FrameStream):
        return frames.frames, frames
    first: Frames = jax.tree.map(jnp.asarray, frames)
    return first, data_parallel.shared(first, devices)


def layout_of(frames: TrainingFrames) -> Frames:
    """Return the frames that a step gets, or their shapes.

    Args:
      frames: The frames on the devices of a model, or their stream.

    Returns:
      Frames, of arrays or of their shapes.
    """
    return frames.layout if isinstance(frames, FrameStream) else frames
