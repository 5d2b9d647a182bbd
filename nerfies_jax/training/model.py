"""Interface of a representation to the training loop, the renderer and the report."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.geometry.camera import Camera

PyTree = Any


class Frames(NamedTuple):
    """Training frames on the device, one row each."""

    images: Any  # [frames, height, width, 3] uint8
    cameras: Camera
    times: Float[Array, " frames"]
    appearance: Int[Array, " frames"]
    valid: Any  # [frames, height, width] bool, or None
    # Data that a model reads only if its `required_data` says so:
    depths: Any = (
        None  # [frames, height, width] float32 z-depth, scene units; 0 unknown
    )
    points: Any = None  # [points, 3] float32 static scene points, scene units
    flow: FrameFlow | None = None  # rows count the frames that are learned from
    moving: Any = None  # [frames, height, width] bool: moves by itself
    # Rows of `images` if it has all frames of the capture; None if it has these.
    image_rows: Any = None

    def image_row(self, row: Any) -> Any:
        """Return the row of `images` that a training frame has."""
        return row if self.image_rows is None else self.image_rows[row]


class View(NamedTuple):
    """Viewpoint and time of an image to render."""

    camera: Camera
    time: Float[Array, ""]
    appearance: Int[Array, ""]


class Rendering(NamedTuple):
    """A rendered image with its opacity and depth."""

    color: Float[Array, "height width 3"]  # sRGB; not clipped
    alpha: Float[Array, "height width"]
    # Expected z-depth, scene units; None in a training step that nobody asks for it.
    depth: Float[Array, "height width"] | None


class TrainState(NamedTuple):
    """Everything needed to continue a run bit for bit, as finite arrays.

    If an array would start at infinity, such as one that tracks a minimum, start it at
    the largest number: the loop stops at anything that is not finite.
    """

    params: PyTree
    optimizer: PyTree
    aux_state: PyTree  # what the representation carries beside: row statistics, ...
    step: Int[Array, ""]
    key: Key[Array, ""]  # of the run; step i uses fold_in(key, i)


def in_default_precision(tree: PyTree) -> PyTree:
    """Move a pytree to the device, with floating-point arrays in default precision.

    That is float32, or float64 if `jax_enable_x64` is on. Random numbers are drawn in
    float32 first, so both precisions start alike.

    Args:
      tree: A pytree of arrays.

    Returns:
      The pytree of JAX arrays. Arrays of other types keep their type.
    """
    default = jnp.result_type(float)

    def convert(leaf):
        leaf = jnp.asarray(leaf)
        wrong = jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.dtype != default
        return leaf.astype(default) if wrong else leaf

    return jax.tree.map(convert, tree)


class Event(NamedTuple):
    """A change of the training state on the host between two chunks.

    Only an event may change the shape of an array.
    """

    name: str
    steps: tuple[int, ...]  # after this many completed steps, sorted
    apply: Callable[[TrainState, Frames], TrainState]


class Stages(NamedTuple):
    """Stages of `Model.render` whose results can be reused.

    `draw(params, deform(params, prepare(params), time), view, size, step)` equals
    `render` up to rounding. `rows(params)` is the part of the result of `deform` that
    an exported file holds, in the same order.
    """

    prepare: Callable[[PyTree], PyTree]  # once for trained parameters
    deform: Callable[[PyTree, PyTree, Float[Array, ""]], PyTree]  # once for an instant
    draw: Callable[[PyTree, PyTree, View, tuple[int, int], Int[Array, ""]], Rendering]
    rows: Callable[[PyTree], PyTree] | None = None


class Surveyed(NamedTuple):
    """`Model.render` accelerated by a survey of space, without gradients.

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
    # (params, view, size, step): `step` says how far the parameters are trained, since
    # what is drawn follows its schedules (coarse-to-fine windows, harmonic degrees).
    render: Callable[[PyTree, View, tuple[int, int], Int[Array, ""]], Rendering]
    events: tuple[Event, ...]
    counts: Callable[[TrainState], dict[str, int]]  # {"gaussians": n, ...}
    # Subset of "depths", "points", "flow" and "moving" that it reads if available.
    required_data: frozenset[str] = frozenset()
    stages: Stages | None = None  # where rendering has parts worth keeping
    surveyed: Surveyed | None = None  # where a survey makes images quicker
    # Faster form of `init` with the same structure, which a checkpoint is read into.
    example: Callable[[Any, Any], TrainState] | None = None
    devices: int = 1  # on which `step` works, by `data_parallel`
    # (params, capture) -> the capture with its cameras as training found them; None
    # where they stay those of the capture.
    found: Callable[[PyTree, Any], Any] | None = None
    # Compiler options of steps and renders (`nerfies_jax.runtime.compiler`).
    compiler_options: Mapping[str, str] | None = None
