"""Interface of a representation to the training loop, the renderer and the report."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.geometry.camera import Camera

PyTree = Any


class StepPixels(NamedTuple):
    """Pixels that steps read from training frames that are not on the device."""

    first: Int[Array, ""]  # number of the first of the steps
    color: Any  # [steps, parts, rays, 3] uint8
    valid: Any  # [steps, parts, rays] bool, or None


class Frames(NamedTuple):
    """Training frames on the device, one row each.

    If they do not fit there (`frame_stream`), pixels are those that the current step
    reads, and other rows are undefined.
    """

    images: Any  # [frames, height, width, 3] uint8
    cameras: Camera
    times: Float[Array, " frames"]
    appearance: Int[Array, " frames"]
    valid: Any  # [frames, height, width] bool, or None
    # Data that a model reads only if its `required_data` says so:
    # z-depth in scene units, 0 where unknown, [frames, height, width] float32
    depths: Any = None
    points: Any = None  # [points, 3] float32 static scene points, scene units
    flow: FrameFlow | None = None  # its rows are training frames
    moving: Any = None  # [frames, height, width] bool, True for moving objects
    # Rows of the training frames in `images`, `valid`, `depths` and `moving` if these
    # have all frames of the capture, or those that the next steps read. None if they
    # have only the training frames.
    image_rows: Any = None
    # Single pixels in place of images, of which none are on the device.
    step_pixels: StepPixels | None = None

    def image_row(self, row: Any) -> Any:
        """Return the row of the arrays of pixels that holds a training frame.

        Args:
          row: Row of the training frame.

        Returns:
          The row of its image, masks and depth.
        """
        return row if self.image_rows is None else self.image_rows[row]

    def of_part(self, step: Int[Array, ""], part: Any) -> "Frames":
        """Select the pixels that a part of a step reads, if single ones are here.

        Args:
          step: Number of completed steps.
          part: Index of the part.

        Returns:
          The frames, for `colors` of this part.
        """
        if self.step_pixels is None:
            return self
        first, *arrays = self.step_pixels
        own = [None if x is None else x[step - first, part] for x in arrays]
        return self._replace(step_pixels=StepPixels(first, *own))

    def colors(self, row: Any, line: Any, column: Any) -> tuple[Any, Any]:
        """Return the colors of pixels, and their masks or None.

        Args:
          row: Training frame of each pixel.
          line: Line of each pixel.
          column: Column of each pixel.

        Returns:
          Colors, [..., 3] uint8, and True where a pixel is valid.
        """
        if self.step_pixels is not None:
            return self.step_pixels.color, self.step_pixels.valid
        pixels = self.image_row(row), line, column
        valid = None if self.valid is None else self.valid[pixels]
        return self.images[pixels], valid


class View(NamedTuple):
    """Viewpoint and time of an image to render."""

    camera: Camera
    time: Float[Array, ""]
    appearance: Int[Array, ""]


class Rendering(NamedTuple):
    """A rendered image with its opacity and depth."""

    color: Float[Array, "height width 3"]  # sRGB; not clipped
    alpha: Float[Array, "height width"]
    # Expected z-depth in scene units. None in a training step that does not use it.
    depth: Float[Array, "height width"] | None


class TrainState(NamedTuple):
    """Everything needed to continue a run bit for bit, as finite arrays.

    Training stops at any value that is not finite. An array that tracks a minimum has
    to start at the largest number instead of infinity.
    """

    params: PyTree
    optimizer: PyTree
    aux_state: PyTree  # further state, such as statistics for densification
    step: Int[Array, ""]
    key: Key[Array, ""]  # key of the run; step i uses fold_in(key, i)


def in_default_precision(tree: PyTree) -> PyTree:
    """Move a pytree to the device, with floating-point arrays in default precision.

    That is float32, or float64 if `jax_enable_x64` is on. Initial random numbers are
    generated in float32, so both precisions start from the same values.

    Args:
      tree: A pytree of arrays.

    Returns:
      The pytree of JAX arrays. Arrays of other types keep their type.
    """
    default = jnp.result_type(float)

    def convert(leaf):
        on_host = not isinstance(leaf, jax.Array)
        leaf = np.asarray(leaf) if on_host else leaf
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            leaf = leaf.astype(default)
        # `jnp.asarray` would compile a program for each shape.
        return jax.device_put(leaf) if on_host else leaf

    return jax.tree.map(convert, tree)


class Event(NamedTuple):
    """A change of the training state on the host between two chunks.

    Only an event may change the shape of an array. Frames that are streamed to the
    device have no pixels in an event.
    """

    name: str
    steps: tuple[int, ...]  # numbers of completed steps, ascending
    apply: Callable[[TrainState, Frames], TrainState]


class Stages(NamedTuple):
    """Stages of `Model.render` whose results can be reused.

    `draw(params, deform(params, prepare(params), time), view, size, step)` equals
    `render` up to rounding. `rows(params)` is the part of the result of `deform` that
    an exported file holds, in the same order.
    """

    prepare: Callable[[PyTree], PyTree]  # once for trained parameters
    deform: Callable[[PyTree, PyTree, Float[Array, ""]], PyTree]  # once per frame time
    draw: Callable[[PyTree, PyTree, View, tuple[int, int], Int[Array, ""]], Rendering]
    rows: Callable[[PyTree], PyTree] | None = None


class Surveyed(NamedTuple):
    """`Model.render` accelerated by precomputed occupancy, without gradients.

    `draw(params, survey(params, step), view, size, step)` equals `render` except for a
    small, tested difference.
    """

    survey: Callable[[PyTree, Int[Array, ""]], PyTree]  # once for trained parameters
    draw: Callable[[PyTree, PyTree, View, tuple[int, int], Int[Array, ""]], Rendering]


class Model(NamedTuple):
    """A representation: pure functions closed over a static spec."""

    spec: Any  # hashable; written into the checkpoint
    init: Callable[[Any, Any], TrainState]  # (Capture, key) -> state; host
    step: Callable[[TrainState, Frames], tuple[TrainState, dict[str, Array]]]
    # (params, view, size, step). `step` is the number of completed training steps,
    # which determines schedules such as coarse-to-fine windows and harmonic degrees.
    render: Callable[[PyTree, View, tuple[int, int], Int[Array, ""]], Rendering]
    events: tuple[Event, ...]
    counts: Callable[[TrainState], dict[str, int]]  # {"gaussians": n, ...}
    # Optional data that the model reads, of "depths", "points", "flow" and "moving".
    required_data: frozenset[str] = frozenset()
    stages: Stages | None = None  # if results of stages of rendering can be reused
    surveyed: Surveyed | None = None  # if a survey accelerates rendering
    # Faster form of `init` that only has to have the structure of a checkpoint.
    example: Callable[[Any, Any], TrainState] | None = None
    devices: int = 1  # that `step` uses (`data_parallel`)
    # (params, capture) -> the capture with refined cameras. None if cameras are not
    # trained.
    apply_to_capture: Callable[[PyTree, Any], Any] | None = None
    # Compiler options of steps and renders (`nerfies_jax.runtime.compiler`).
    compiler_options: Mapping[str, str] | None = None
    # Numbers of the capture that the functions above read, a pytree of floats and
    # arrays, and a function (model, numbers) -> the model for other numbers, which may
    # be traced (`training.programs`). None: they are compiled into the programs.
    numbers: PyTree = None
    with_numbers: Callable[["Model", PyTree], "Model"] | None = None
    # (key of the run, number of completed steps, frames) -> the pixels that a step
    # reads, as indices of `Frames.images`: (rows,) of training frames, [views], or
    # (rows, lines, columns), [parts, rays]. None: frames must fit on the device.
    reads: Callable[[Any, Any, Frames], tuple[Any, ...]] | None = None
