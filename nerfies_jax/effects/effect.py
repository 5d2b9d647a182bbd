"""What the effects of a radiance field see of a ray, and what they say of it.

The seams themselves are those of `nerfies_jax.training.effects`.

Everything here is in field coordinates: `nerfies_jax.scene` shifts and scales rays so
that the filmed volume fills a box around the origin. Functions of a point are written
for one point and vmapped by the scene.
"""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.training.effects import FrameCondition

Vector = Float[Array, "3"]
Scalar = Float[Array, ""]


class Sample(NamedTuple):
    """One sample of one ray, as a second medium sees it."""

    point: Vector  # where it was observed; no warp applied
    direction: Vector  # of the ray, unit length
    features: Float[Array, " width"]  # last hidden layer of the template's trunk there


class Medium(NamedTuple):
    """What else is on the ray, at one sample."""

    density: Scalar  # per unit of the field
    color: Vector  # in [0, 1]
    # Logit of the share of this medium's opacity, the static one gets the rest (NSFF's
    # blending); None gives both all of theirs (NeRF-W).
    share: Scalar | None = None
    beta: Scalar | None = None  # how uncertain the color is (NeRF-W)
    extras: dict[str, Array] = {}  # noqa: RUF012  what the penalty needs again


class Surface(NamedTuple):
    """One sample of one ray, as color sees it; slopes reach none of the parameters."""

    point: Vector  # where it was observed
    features: Float[Array, " width"]  # last hidden layer of the level's trunk there
    # A normal in the template as one in the observation: by the transpose of the
    # Jacobian of all warps, so of another length.
    turned: Callable[[Vector], Vector]
    outward: Callable[[], Vector]  # against the slope of the template's density


class Look(NamedTuple):
    """What an effect found at a surface."""

    features: Float[Array, " features"]  # that color reads
    found: dict[str, Array] = {}  # noqa: RUF012  what the penalty needs again


class RayOutput(NamedTuple):
    """One ray (or a batch) as one level of sampling renders it."""

    distances: Float[Array, "*rays samples"]
    point: Float[Array, "*rays samples 3"]  # where it was observed
    warped: Float[Array, "*rays samples 3"]  # where the template was asked
    static_weight: Float[Array, "*rays samples"]
    media: dict[str, Medium]  # by effect, leaves with leading axes rays and samples
    media_weight: dict[str, Float[Array, "*rays samples"]]
    color: Float[Array, "*rays 3"]
    alpha: Float[Array, "*rays"]
    distance: Float[Array, "*rays"]  # expected, units of the field
    median_distance: Float[Array, "*rays"]
    beta: Float[Array, "*rays"] | None  # standard deviation of the color, or None
    spacing: Float[Array, "*rays samples"]  # what length each sample stands for
    # Known to be behind the samples; None: the last one stands for all behind it.
    background: Float[Array, "*rays 3"] | None
    # What surfaces found, by effect, leaves with leading axes rays and samples.
    looks: dict[str, dict[str, Array]] = {}  # noqa: RUF012

    @property
    def weight(self) -> Float[Array, "*rays samples"]:
        """Of all media together: how much of the ray ends at each sample."""
        return sum(self.media_weight.values(), self.static_weight)


class Batch(NamedTuple):
    """The rays of one step and what was filmed there; leading axis rays."""

    row: Int[Array, " rays"]  # of the frames learned from
    pixel: Float[Array, "rays 2"]
    origin: Float[Array, "rays 3"]
    direction: Float[Array, "rays 3"]
    cosine: Float[Array, " rays"]  # z-depth per distance along the ray
    color: Float[Array, "rays 3"]
    valid: Bool[Array, " rays"]


class Box(NamedTuple):
    """`field = (scene - center) * scale`."""

    center: Vector  # scene units
    scale: Scalar


def guides_of(
    names: tuple[str, ...], condition: FrameCondition
) -> list[Float[Array, "1"]]:
    """What effects said of a point, by name; ValueError for what none said."""
    missing = [name for name in names if name not in condition.codes]
    if missing:
        raise ValueError(
            f"guides name {missing[0]!r}, which no effect says of a point; there are "
            f"{', '.join(sorted(condition.codes))}"
        )
    return [condition.codes[name] for name in names]
