"""The seams an effect may fill on a radiance field.

An effect is a frozen spec that says *which* and this record of pure functions that
says *how*. A seam left `None` has no parameters, no state and no operations: the
compiled step of a field without effects is that of a static NeRF.

Everything here is in field coordinates: `nerfies_jax.scene` shifts and scales rays so
that the filmed volume fills a box around the origin. Functions of a point are written
for one point and vmapped by the scene.
"""

import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float, Int, Key

from nerfies_jax.training.model import Frames

PyTree = Any
Vector = Float[Array, "3"]
Scalar = Float[Array, ""]

# What a table of codes has a row for: the distinct times that were learnt from, or the
# exposures ("appearance ids") of the capture.
MOMENT, APPEARANCE = "moment", "appearance"


class Table(NamedTuple):
    """A latent table; effects that name the same one share its codes."""

    name: str
    by: str  # MOMENT or APPEARANCE
    width: int


class FrameCondition(NamedTuple):
    """When a ray was filmed, and what is known of that frame."""

    time: Scalar  # in [0, 1] over the capture
    codes: dict[str, Float[Array, " code"]]  # by table, looked up
    step: Int[Array, ""]  # completed steps of training; schedules are functions of it


class Sample(NamedTuple):
    """One sample of one ray, as a second medium sees it."""

    point: Vector  # where it was observed; no warp applied
    direction: Vector  # of the ray, unit length
    features: Float[Array, " width"]  # last hidden layer of the template's trunk there


class Medium(NamedTuple):
    """What else is on the ray, at one sample."""

    density: Scalar  # per unit of the field
    colour: Vector  # in [0, 1]
    # Logit of the share of this medium's opacity, the static one gets the rest (NSFF's
    # blending); None gives both all of theirs (NeRF-W).
    share: Scalar | None = None
    beta: Scalar | None = None  # how uncertain the colour is (NeRF-W)
    extras: dict[str, Array] = {}  # noqa: RUF012  what the penalty needs again


class RayOutput(NamedTuple):
    """One ray (or a batch) as one level of sampling renders it."""

    distances: Float[Array, "*rays samples"]
    point: Float[Array, "*rays samples 3"]  # where it was observed
    warped: Float[Array, "*rays samples 3"]  # where the template was asked
    static_weight: Float[Array, "*rays samples"]
    media: dict[str, Medium]  # by effect, leaves with leading axes rays and samples
    media_weight: dict[str, Float[Array, "*rays samples"]]
    colour: Float[Array, "*rays 3"]
    alpha: Float[Array, "*rays"]
    distance: Float[Array, "*rays"]  # expected, units of the field
    median_distance: Float[Array, "*rays"]
    beta: Float[Array, "*rays"] | None  # standard deviation of the colour, or None

    @property
    def weight(self) -> Float[Array, "*rays samples"]:
        """Of all media together: how much of the ray ends at each sample."""
        return sum(self.media_weight.values(), self.static_weight)


class Batch(NamedTuple):
    """The rays of one step and what was filmed there; leading axis rays."""

    row: Int[Array, " rays"]  # of the frames learnt from
    pixel: Float[Array, "rays 2"]
    origin: Float[Array, "rays 3"]
    direction: Float[Array, "rays 3"]
    cosine: Float[Array, " rays"]  # z-depth per distance along the ray
    colour: Float[Array, "rays 3"]
    valid: Bool[Array, " rays"]


class Box(NamedTuple):
    """`field = (scene - centre) * scale`."""

    centre: Vector  # scene units
    scale: Scalar


class Context(NamedTuple):
    """What a penalty may look at: one step's rays as rendered, and the field itself."""

    displace: Callable[[Vector, FrameCondition], Vector]  # of all warps together
    condition_of: Callable[[Int[Array, ""]], FrameCondition]  # of one frame learnt from
    conditions: FrameCondition  # of the rays; leading axis rays
    batch: Batch
    levels: tuple[RayOutput, ...]  # coarse to fine; leading axis rays
    frames: Frames  # all that is learnt from, in scene units
    box: Box
    step: Int[Array, ""]
    key: Key[Array, ""]  # of this effect in this step


class Term(NamedTuple):
    """One term of the loss; `value` is logged, `weight * value` is descended."""

    value: Scalar
    weight: Scalar | float


class Effect(NamedTuple):
    """What one effect does, each seam optional.

    `params` is always the effect's own, what its `init` returned; an effect without
    `init` gets None.
    """

    name: str
    tables: tuple[Table, ...] = ()
    init: Callable[[Key[Array, ""]], PyTree] | None = None
    # (params, condition) -> what the colour branch reads beside the view direction
    condition: Callable[[PyTree, FrameCondition], Float[Array, " features"]] | None = (
        None
    )
    condition_width: int = 0
    # (params, point, condition) -> displacement: template point minus observed point
    displace: Callable[[PyTree, Vector, FrameCondition], Vector] | None = None
    # (params, observed point, condition) -> features the trunk reads beside the point's
    lift: (
        Callable[[PyTree, Vector, FrameCondition], Float[Array, " features"]] | None
    ) = None
    lift_width: int = 0
    # (params, sample, condition); on the last level only
    medium: Callable[[PyTree, Sample, FrameCondition], Medium] | None = None
    penalty: Callable[[PyTree, Context], dict[str, Term]] | None = None
    required_data: frozenset[str] = (
        frozenset()
    )  # of "depths", "points", "flow" in `Frames`


def stream(name: str) -> int:
    """What to fold into a key for an effect or a table of this name.

    Counted instead, what comes behind an effect would be drawn anew when it is left
    out, and an ablation would compare two starts as well.
    """
    return zlib.crc32(name.encode())
