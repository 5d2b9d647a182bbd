"""What a representation must offer the loop, the renderer and the report."""

from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.geometry.camera import Camera

PyTree = Any


class Frames(NamedTuple):
    """The frames to learn from, on the device, one row each."""

    images: Any  # [frames, height, width, 3] uint8
    cameras: Camera
    times: Float[Array, " frames"]
    appearance: Int[Array, " frames"]
    valid: Any  # [frames, height, width] bool, or None
    # What a model reads only where its `required_data` says so:
    depths: Any = (
        None  # [frames, height, width] float32 z-depth, scene units; 0 unknown
    )
    points: Any = None  # [points, 3] float32 static scene points, scene units
    flow: FrameFlow | None = None  # rows count the frames that are learned from
    moving: Any = None  # [frames, height, width] bool: moves by itself


class View(NamedTuple):
    """What to render: from where, and when."""

    camera: Camera
    time: Float[Array, ""]
    appearance: Int[Array, ""]


class Rendering(NamedTuple):
    """One whole frame."""

    color: Float[Array, "height width 3"]  # sRGB; not clipped
    alpha: Float[Array, "height width"]
    # Expected z-depth, scene units; None in a training step that nobody asks for it.
    depth: Float[Array, "height width"] | None


class TrainState(NamedTuple):
    """Everything a run needs to continue bit for bit; arrays only, all of them finite.

    Where an array would start at infinity, such as one that keeps a least value, let it
    start at the largest number: the loop stops at whatever is not finite.
    """

    params: PyTree
    optimizer: PyTree
    aux_state: PyTree  # what the representation carries beside: row statistics, ...
    step: Int[Array, ""]
    key: Key[Array, ""]  # of the run; step i uses fold_in(key, i)


def in_default_precision(tree: PyTree) -> PyTree:
    """A pytree on the device, its floating arrays as `jax_enable_x64` says.

    float32, or float64 where it is on; what is drawn at random is drawn in float32
    first, so both precisions start alike. Other arrays stay as they are.
    """
    default = jnp.result_type(float)

    def convert(leaf):
        leaf = jnp.asarray(leaf)
        wrong = jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.dtype != default
        return leaf.astype(default) if wrong else leaf

    return jax.tree.map(convert, tree)


class Event(NamedTuple):
    """Something that happens on the host between two chunks.

    Only an event may change the shape of an array.
    """

    name: str
    steps: tuple[int, ...]  # after this many completed steps, sorted
    apply: Callable[[TrainState, Frames], TrainState]


class Stages(NamedTuple):
    """`Model.render` in parts, so that nothing is computed twice.

    `draw(params, deform(params, prepare(params), time), view, size, step)` is what
    that `render` gives, to rounding. `rows(params)` is what a file holds of what
    `deform` returns, in the same order.
    """

    prepare: Callable[[PyTree], PyTree]  # once for trained parameters
    deform: Callable[[PyTree, PyTree, Float[Array, ""]], PyTree]  # once for an instant
    draw: Callable[[PyTree, PyTree, View, tuple[int, int], Int[Array, ""]], Rendering]
    rows: Callable[[PyTree], PyTree] | None = None


class Surveyed(NamedTuple):
    """`Model.render` for pictures, which need no slopes, once space is surveyed.

    `draw(params, survey(params, step), view, size, step)` is what `render` gives but
    for a small, tested difference.
    """

    survey: Callable[[PyTree, Int[Array, ""]], PyTree]  # once for trained parameters
    draw: Callable[[PyTree, PyTree, View, tuple[int, int], Int[Array, ""]], Rendering]


class Model(NamedTuple):
    """A representation: pure functions closed over a static spec."""

    spec: Hashable  # written into the checkpoint
    init: Callable[[Any, Any], TrainState]  # (Capture, key) -> state; host
    step: Callable[[TrainState, Frames], tuple[TrainState, dict[str, Array]]]
    # (params, view, size, step): `step` says how far the parameters are trained, since
    # what is drawn follows its schedules (coarse-to-fine windows, harmonic degrees).
    render: Callable[[PyTree, View, tuple[int, int], Int[Array, ""]], Rendering]
    events: tuple[Event, ...]
    counts: Callable[[TrainState], dict[str, int]]  # {"gaussians": n, ...}
    # Which of "depths", "points", "flow", "moving" it reads, where a capture has them.
    required_data: frozenset[str] = frozenset()
    stages: Stages | None = None  # where rendering has parts worth keeping
    surveyed: Surveyed | None = None  # where a survey makes pictures quicker
    # As `init`, of the same structure and quicker: what a checkpoint is read into.
    example: Callable[[Any, Any], TrainState] | None = None
    devices: int = 1  # on which `step` works, by `data_parallel`
    # (params, capture) -> the capture with its cameras as training found them; None
    # where they stay those of the capture.
    found: Callable[[PyTree, Any], Any] | None = None
    # Of the compiler, for steps and pictures (`nerfies_jax.compiler`).
    compiler_options: Mapping[str, str] | None = None
