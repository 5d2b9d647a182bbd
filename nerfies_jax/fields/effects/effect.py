"""Inputs and outputs of the effects of a radiance field on a ray.

The hooks of effects are those of `nerfies_jax.training.effects`. Everything here is in
field coordinates: `nerfies_jax.scene.scene` shifts and scales rays so that the captured
volume fills a box around the origin. Functions of a point take one point, and the scene
vmaps them.
"""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.training.effects import FrameCondition

Vector = Float[Array, "3"]
Scalar = Float[Array, ""]


class Sample(NamedTuple):
    """One sample of one ray, as the input of a second medium."""

    point: Vector  # where it was observed; no warp applied
    direction: Vector  # of the ray, unit length
    features: Float[Array, " width"]  # last hidden layer of the template's trunk there


class Medium(NamedTuple):
    """A second medium at one sample of a ray."""

    density: Scalar  # per unit of the field
    color: Vector  # in [0, 1]
    # Logit of the share of this medium's opacity, the static one gets the rest (NSFF's
    # blending); None gives both all of theirs (NeRF-W).
    share: Scalar | None = None
    beta: Scalar | None = None  # how uncertain the color is (NeRF-W)
    extras: dict[str, Array] = {}  # noqa: RUF012  what the penalty needs again


class Surface(NamedTuple):
    """One sample of one ray, as the input of color. Gradients reach no parameters."""

    point: Vector  # where it was observed
    features: Float[Array, " width"]  # last hidden layer of the level's trunk there
    # A normal in the template as one in the observation: by the transpose of the
    # Jacobian of all warps, so of another length.
    turned: Callable[[Vector], Vector]
    outward: Callable[[], Vector]  # against the gradient of the template's density


class Look(NamedTuple):
    """Output of an effect at a surface."""

    features: Float[Array, " features"]  # that color reads
    found: dict[str, Array] = {}  # noqa: RUF012  what the penalty needs again


class RayOutput(NamedTuple):
    """Output of one level of sampling for one ray or a batch."""

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
    # Outputs at surfaces by effect, with leaves [rays, samples, ...].
    looks: dict[str, dict[str, Array]] = {}  # noqa: RUF012

    @property
    def weight(self) -> Float[Array, "*rays samples"]:
        """Rendering weight of each sample, for all media together."""
        return sum(self.media_weight.values(), self.static_weight)


class Batch(NamedTuple):
    """Rays of one step and their observed colors, with rays along the leading axis."""

    row: Int[Array, " rays"]  # of the frames learned from
    pixel: Float[Array, "rays 2"]
    origin: Float[Array, "rays 3"]
    direction: Float[Array, "rays 3"]
    cosine: Float[Array, " rays"]  # z-depth per distance along the ray
    color: Float[Array, "rays 3"]
    valid: Bool[Array, " rays"]


class Box(NamedTuple):
    """Transform to field coordinates, `field = (scene - center) * scale`."""

    center: Vector  # scene units
    scale: Scalar


def guides_of(
    names: tuple[str, ...], condition: FrameCondition
) -> list[Float[Array, "1"]]:
    """Return the per-point codes of some names.

    Args:
      names: Names of the codes.
      condition: Conditioning of a point.

    Returns:
      The codes, [1] each.

    Raises:
      ValueError: If no effect provides a code of that name.
    """
    missing = [name for name in names if name not in condition.codes]
    if missing:
        raise ValueError(
            f"guides name {missing[0]!r}, which no effect says of a point; there are "
            f"{', '.join(sorted(condition.codes))}"
        )
    return [condition.codes[name] for name in names]
