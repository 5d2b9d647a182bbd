"""Transient objects of single exposures, and the uncertainty of their colors.

NeRF-W (Martin-Brualla et al. 2021, arXiv:2008.02268, "transient objects"): next to the
static field each photograph has its own medium with density, color and an uncertainty
`beta`, which represents people and cars. Renders include it. Held-out frames use codes
interpolated between those of their neighbors in time. It is left out by
`variants.without_effects`, and in the evaluation of `held_out_codes.scorer`, as in the
paper.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Key

from nerfies_jax.fields.effects.effect import Medium, Sample
from nerfies_jax.nn import mlp
from nerfies_jax.nn.mlp import MLP, HeadSpec, MLPSpec
from nerfies_jax.training import losses
from nerfies_jax.training.effects import (
    APPEARANCE,
    FrameCondition,
    PenaltyContext,
    Table,
    Term,
)
from nerfies_jax.training.step_counts import steps

NAME = TABLE = "transient"


@dataclasses.dataclass(frozen=True)
class TransientSpec:
    """Settings of the medium and its losses.

    The defaults are those of the paper and its public reimplementation. `beta_min` is
    the minimum standard deviation of a ray's color, in units of color. It bounds the
    loss from below. Without it an exactly matched pixel would have an unbounded
    likelihood. `density_weight` is lambda_u of the paper, which keeps the static scene
    out of the transient medium. `beta_power` is that of `photometric`. Zero is the loss
    of the paper. With one, short runs also learn regions of high uncertainty.

    The medium ends at the far plane, as people and cars do. The static field is opaque
    behind it.

    The medium is absent for `hold_steps`, so that the static scene explains what it
    can before. `density_bias` is added to the density before its activation. Negative
    values start with less density, and the static scene is visible through it.
    """

    code_width: int = 16
    depth: int = 4
    width: int = 128
    beta_min: float = 0.03
    density_weight: float = 0.01
    beta_power: float = 0.0
    density_bias: float = 0.0
    hold_steps: int = steps(0)

    name = NAME

    def __post_init__(self):
        if self.code_width < 1:
            raise ValueError(
                f"code_width={self.code_width} must be at least 1: all exposures would "
                "share one transient"
            )
        if not (math.isfinite(self.beta_min) and self.beta_min > 0):
            raise ValueError(
                f"beta_min={self.beta_min} must be positive: the logarithm of beta is "
                "unbounded below; the paper has 0.03"
            )
        if not (math.isfinite(self.density_weight) and self.density_weight >= 0):
            raise ValueError(
                f"density_weight={self.density_weight} must be finite and not negative"
            )
        if not 0 <= self.beta_power <= 2:
            raise ValueError(
                f"beta_power={self.beta_power} must be in [0, 2]: 0 is the likelihood, "
                "at 2 colors learn as from a squared error"
            )
        if not math.isfinite(self.density_bias):
            raise ValueError(f"density_bias={self.density_bias} must be finite")
        if self.hold_steps < 0:
            raise ValueError(
                f"hold_steps={self.hold_steps} must not be negative; 0 starts with the "
                "medium"
            )
        network(self, 1)  # refuses wrong depths and widths

    @property
    def tables(self) -> tuple[Table, ...]:
        """Table of the codes that it reads."""
        return (Table(TABLE, APPEARANCE, self.code_width),)

    def init(self, key: Key[Array, ""], features: int) -> MLP:
        """Initialize the network, for a trunk of `features` features."""
        return init(self, key, features)

    def apply(self, params: MLP, sample: Sample, frame: FrameCondition) -> Medium:
        """Compute the medium at one sample."""
        return medium(self, params, sample, frame)

    def loss(self, params: MLP | None, context: PenaltyContext) -> dict[str, Term]:
        """Compute the penalty on its density."""
        return penalty(self, context)


def network(spec: TransientSpec, features: int) -> MLPSpec:
    """Return the settings of the network from [template features, code] to the medium.

    Args:
      spec: Settings.
      features: Width of the template's trunk.

    Returns:
      Settings of an MLP with the heads "density", "color" and "beta", before
      activation.
    """
    heads = (("density", 1), ("color", 3), ("beta", 1))
    return MLPSpec(
        inputs=features + spec.code_width,
        depth=spec.depth,
        width=spec.width,
        heads=tuple((name, HeadSpec(width)) for name, width in heads),
    )


def init(
    spec: TransientSpec,
    key: Key[Array, ""],
    features: int,
    dtype: DTypeLike = jnp.float32,
) -> MLP:
    """Initialize with Glorot weights.

    The medium starts with about the density of the static field.

    Args:
      spec: Settings.
      key: PRNG key.
      features: Width of the template's trunk.
      dtype: Floating-point type of the parameters.

    Returns:
      The parameters.
    """
    return mlp.init(network(spec, features), key, dtype)


def medium(
    spec: TransientSpec, params: MLP, sample: Sample, condition: FrameCondition
) -> Medium:
    """Evaluate density, color and uncertainty of the medium at one sample.

    The trunk is shared and gets gradients from both media, as in the paper.

    Args:
      spec: Settings.
      params: Parameters.
      sample: The sample.
      condition: Conditioning of the frame.

    Returns:
      The medium.
    """
    inputs = jnp.concatenate([sample.features, condition.codes[TABLE]])
    raw = mlp.apply(network(spec, sample.features.shape[-1]), params, inputs)
    density = raw["density"][0]
    if spec.density_bias:
        density = density + spec.density_bias
    density = jax.nn.softplus(density)
    if spec.hold_steps and condition.step is not None:
        density = jnp.where(condition.step < spec.hold_steps, 0, density)
    return Medium(
        density=density,
        color=jax.nn.sigmoid(raw["color"]),
        beta=jax.nn.softplus(raw["beta"][0]),
    )


def uncertainty(
    beta_min: float,
    weights: Float[Array, "*rays samples"],
    beta: Float[Array, "*rays samples"],
) -> Float[Array, "*rays"]:
    """Compute the standard deviation of a ray's color, beta_min + Σ w β.

    The paper has β_min inside the sum, so that a ray without transient objects has a β
    of zero and an infinite loss. As in the public reimplementation it is added outside.

    Args:
      beta_min: Minimum standard deviation.
      weights: Rendering weights of the transient medium, [..., samples].
      beta: Uncertainty of the samples, [..., samples].

    Returns:
      Standard deviations, [...].
    """
    return beta_min + jnp.sum(weights * beta, axis=-1)


def photometric(
    color: Float[Array, "*rays 3"],
    truth: Float[Array, "*rays 3"],
    beta: Float[Array, "*rays"],
    valid: Bool[Array, "*rays"] | None,
    beta_power: float = 0.0,
) -> Float[Array, ""]:
    """Compute the mean over rays of (|color - truth|² / 2β² + log β) [β]^beta_power.

    With a power of zero these are the first two terms of equation 13, which has log
    β² / 2 as the second term. For a given residual the minimum is at β = |color -
    truth|. The loss is at least log beta_min and negative for good fits. The public
    reimplementation adds 3 to keep it positive, which does not change gradients, and
    takes the mean over the channels, which divides the first term by three.

    [β] is β without gradient. With a power of zero the gradient of colors is scaled by
    1/β². Regions that a short run has not learned yet are assigned a high uncertainty
    and are then not learned, such as the texture of a floor. With a power of one the
    scale is 1/β, and with two it is uniform. In all cases β converges to
    |color - truth|.

    Args:
      color: Rendered colors, [..., 3].
      truth: Observed colors, [..., 3].
      beta: Standard deviations, positive, [...].
      valid: True for observed pixels, [...]. None for all.
      beta_power: Power in [0, 2].

    Returns:
      The loss, a scalar.

    References:
      Martin-Brualla et al. 2021, equation 13. Seitzer et al. 2022, arXiv:2203.09168
      (β-NLL, whose β is half of this power).
    """
    if valid is not None:
        # Masked before the square and the division, because unobserved pixels may be
        # NaN.
        color = jnp.where(valid[..., None], color, 0)
        truth = jnp.where(valid[..., None], truth, 0)
        beta = jnp.where(valid, beta, 1)
    # Divided first, so that the square of a residual far below beta does not underflow.
    residual = (color - truth) / beta[..., None]
    each = jnp.sum(jnp.square(residual), axis=-1) / 2 + jnp.log(beta)
    if beta_power:
        each = each * jax.lax.stop_gradient(beta) ** beta_power
    return losses.masked_mean(each[..., None], valid)


def penalty(spec: TransientSpec, context: PenaltyContext) -> dict[str, Term]:
    """Compute the mean transient density of the finest samples of the valid rays.

    It is the last term of equation 13, in units of the field. If the box is scaled by
    s, densities of the same image scale by 1/s.

    Args:
      spec: Settings.
      context: Context of the step.

    Returns:
      The terms "density", and "share": the mean opacity of the medium, which is not
      part of the loss.
    """
    level = context.levels[-1]
    value = losses.masked_mean(level.media[NAME].density, context.batch.valid)
    opacity = jnp.sum(level.media_weight[NAME], axis=-1)
    share = losses.masked_mean(opacity[..., None], context.batch.valid)
    return {"density": Term(value, spec.density_weight), "share": Term(share, None)}
