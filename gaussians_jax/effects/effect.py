"""The seams an effect may fill on a scene of Gaussians.

An effect is a frozen spec that says *which* and this record of pure functions that
says *how*. A seam left `None` has no parameters, no state and no operations: the
compiled step of a scene without effects is that of a static scene.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.splats import Gaussians, Params, Splats
from nerfies_jax.training.model import Rendering

PyTree = Any


class Moment(NamedTuple):
    """When a scene is drawn, and at which step of which run if it is being trained."""

    time: Float[Array, ""]  # in [0, 1] over the capture
    step: Int[Array, ""] | None = None  # None once trained
    key: Key[Array, ""] | None = None


class Shot(NamedTuple):
    """One frame as it was drawn and as it was filmed."""

    rendering: Rendering | None  # None where a loss brings its own
    truth: Float[Array, "height width 3"]  # sRGB in [0, 1]
    valid: Bool[Array, "height width"] | None  # None: everywhere
    depth: Float[Array, "height width"] | None  # z-depth, scene units; 0 unknown


class Around(NamedTuple):
    """What a penalty may ask of the scene beside the frame that is drawn."""

    params: Params
    # Gaussians of any choice of rows (`splats.take_rows`) at any time.
    at_time: Callable[[Params, Float[Array, ""]], Gaussians]
    moment: Moment
    carried: PyTree  # of this effect; None where it carries nothing


class Term(NamedTuple):
    """A summand of the loss, weighted, and numbers to log beside it."""

    value: Float[Array, ""]
    metrics: dict[str, Float[Array, ""]]


Rate = Callable[[Int[Array, ""]], Float[Array, ""]]  # learning rate at a traced step


class Effect(NamedTuple):
    """What one effect does, each seam optional."""

    name: str  # its key in `Params.rows`, `Params.nets` and what is carried
    init_rows: Callable[[Any, Splats], PyTree] | None = None  # (key, splats) -> rows
    init_nets: Callable[[Any], PyTree] | None = None  # key -> nets
    row_rate: Rate | None = None  # where there are rows
    net_rate: Rate | None = None  # where there are nets
    warm_up: int = 0  # steps before which it does not deform
    # What stays as it is while the parameters do, whatever the time.
    prepare: Callable[[Params], PyTree] | None = None
    # The last argument is what `prepare` returned, None without it.
    deform: Callable[[Params, Gaussians, Moment, PyTree], Gaussians] | None = None
    image_loss: Callable[[Params, Shot, Moment], Term] | None = None
    penalty: Callable[[Around], Term] | None = None
    # Host side, at the start and after every change of the rows: what the steps up to
    # the next change carry. Arrays only.
    carry: Callable[[Params], PyTree] | None = None
    # (carried, canonical, moved, moment) -> carried; pure, in every step
    observe: Callable[[PyTree, Gaussians, Gaussians, Moment], PyTree] | None = None
    # (carried, step) -> [rows] factor of the gradient that densification
    # compares with its threshold; host side
    grow_score: Callable[[PyTree, int], np.ndarray] | None = None
    # Of `Frames`, beside pictures and cameras; who wants "depths" gets them drawn too.
    wants: frozenset[str] = frozenset()
