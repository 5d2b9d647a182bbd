"""Inputs and outputs of the effects of a radiance field.

Everything is in field coordinates. `nerfies_jax.scene.scene` shifts and scales rays so
that the captured volume fills a box around the origin. Functions take one point, and
the scene vectorizes them.
"""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.training.effects import FrameCondition

Vector = Float[Array, "3"]
Scalar = Float[Array, ""]


class Sample(NamedTuple):
    """One sample of one ray, as the input of a second medium."""

    point: Vector  # observed point, before any warp
    direction: Vector  # unit direction of the ray
    features: Float[Array, " width"]  # last hidden layer of the template's trunk


class Medium(NamedTuple):
    """A second medium at one sample of a ray."""

    density: Scalar  # per unit of the field
    color: Vector  # in [0, 1]
    # Logit of the blending weight v of NSFF: the opacity of this medium is multiplied
    # by v and that of the static field by 1 - v. None to multiply neither (NeRF-W).
    share: Scalar | None = None
    beta: Scalar | None = None  # uncertainty of the color (NeRF-W)
    extras: dict[str, Array] = {}  # noqa: RUF012  further values for the loss


class Surface(NamedTuple):
    """One sample of one ray, as the input of the color of surfaces.

    The functions have no gradient with respect to parameters.
    """

    point: Vector  # observed point
    features: Float[Array, " width"]  # last hidden layer of the level's trunk
    # Transforms a normal in the template to the observation, by the transpose of the
    # Jacobian of all warps. The length changes.
    observed_normal: Callable[[Vector], Vector]
    # Negative gradient of the density in the template.
    template_normal: Callable[[], Vector]


class SurfaceOutput(NamedTuple):
    """Output of an effect at a surface."""

    features: Float[Array, " features"]  # inputs of the color branch
    values: dict[str, Array] = {}  # noqa: RUF012  further values for the loss


class RayOutput(NamedTuple):
    """Output of one level of sampling for one ray or a batch."""

    distances: Float[Array, "*rays samples"]
    point: Float[Array, "*rays samples 3"]  # observed points
    warped: Float[Array, "*rays samples 3"]  # points in the template
    static_weight: Float[Array, "*rays samples"]
    media: dict[str, Medium]  # by effect, leaves [rays, samples, ...]
    media_weight: dict[str, Float[Array, "*rays samples"]]
    color: Float[Array, "*rays 3"]
    alpha: Float[Array, "*rays"]
    distance: Float[Array, "*rays"]  # expected distance, units of the field
    median_distance: Float[Array, "*rays"]
    beta: Float[Array, "*rays"] | None  # standard deviation of the color, or None
    spacing: Float[Array, "*rays samples"]  # length of the interval of each sample
    # Known color behind the ray. None if the last sample represents everything behind.
    background: Float[Array, "*rays 3"] | None
    # `SurfaceOutput.values` by effect, with leaves [rays, samples, ...].
    surfaces: dict[str, dict[str, Array]] = {}  # noqa: RUF012

    @property
    def weight(self) -> Float[Array, "*rays samples"]:
        """Rendering weight of each sample, summed over all media."""
        return sum(self.media_weight.values(), self.static_weight)


class Batch(NamedTuple):
    """Rays of one step and their observed colors, with rays along the leading axis."""

    row: Int[Array, " rays"]  # training frame
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
            f"no effect provides the per-point code {missing[0]!r} in guides; choose "
            f"from {', '.join(sorted(condition.codes))}"
        )
    return [condition.codes[name] for name in names]
