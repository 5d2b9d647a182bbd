"""The seams an effect may fill on a scene of Gaussians.

An effect is a frozen spec that says *which* and this record of pure functions that
says *how*. A seam left `None` has no parameters, no state and no operations: the
compiled step of a scene without effects is that of a static scene.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int, Key

from gaussians_jax.splats import Gaussians, Params

PyTree = Any


class Moment(NamedTuple):
    """When a scene is drawn, and at which step of which run if it is being trained."""

    time: Float[Array, ""]  # in [0, 1] over the capture
    step: Int[Array, ""] | None = None  # None once trained
    key: Key[Array, ""] | None = None


class Effect(NamedTuple):
    """What one effect does, each seam optional."""

    name: str  # its key in `Params.rows` and `Params.nets`
    init_rows: Callable[[Any, int], PyTree] | None = None  # (key, rows) -> rows
    init_nets: Callable[[Any], PyTree] | None = None  # key -> nets
    learning_rate: Callable[[Int[Array, ""]], Float[Array, ""]] | None = None
    deform: Callable[[Params, Gaussians, Moment], Gaussians] | None = None
