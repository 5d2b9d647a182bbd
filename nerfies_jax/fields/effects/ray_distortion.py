"""Distortion loss, which keeps the density of each ray at one surface.

Barron et al. 2022 (mip-NeRF 360), arXiv:2111.12077, equation 15: without it, density
spreads in front of surfaces and behind them, where no image refutes it.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.fields.effects.effect import Scalar
from nerfies_jax.geometry.precision import at_least_float32
from nerfies_jax.training import losses
from nerfies_jax.training.effects import PenaltyContext, PyTree, Term


@dataclasses.dataclass(frozen=True)
class DistortionSpec:
    """Weight of the distortion loss of the finest samples.

    The default is that of the paper.
    """

    weight: float = 0.01

    name = "distortion"

    def __post_init__(self):
        if not (math.isfinite(self.weight) and self.weight >= 0):
            raise ValueError(
                f"weight={self.weight} of distortion must be finite and not negative"
            )

    def loss(self, params: PyTree, context: PenaltyContext) -> dict[str, Term]:
        """Compute the mean distortion of the static field over the valid rays."""
        level = context.levels[-1]
        ends = jax.vmap(contracted_edges)(level.distances, level.spacing)
        each = jax.vmap(distortion_loss)(level.static_weight, ends)
        value = losses.masked_mean(each[..., None], context.batch.valid)
        return {"loss": Term(value, self.weight)}


def contracted_edges(
    distances: Float[Array, " samples"], spacing: Float[Array, " samples"]
) -> Float[Array, " edges"]:
    """Return the ends of the intervals of a ray in contracted distance.

    The distance d, in units of the field, becomes d / (1 + d): differences are those
    of distance close to the camera and those of disparity far from it, as in the
    paper, and infinity is 1.

    Args:
      distances: Sorted distances of the samples in units of the field, [samples].
      spacing: Lengths of their intervals, [samples].

    Returns:
      Sorted values in [0, 1], one more than samples, [samples + 1].
    """
    ends = jnp.concatenate([distances, distances[-1:] + spacing[-1:]])
    return ends / (1 + ends)


@at_least_float32
def distortion_loss(
    weights: Float[Array, " samples"], edges: Float[Array, " edges"]
) -> Scalar:
    """Compute the mean distance between two points of a ray, by weight.

    It is Σ_ij w_i w_j |m_i - m_j| + Σ_i w_i² (e_{i+1} - e_i) / 3 for the middles m of
    the intervals, the integral of equation 15 for weights that are constant in each
    interval. It is zero for a ray without weight, and smallest if all weight is in one
    short interval.

    Args:
      weights: Rendering weights, [samples].
      edges: Sorted ends of the intervals, [samples + 1].

    Returns:
      The loss, a scalar.

    References:
      Barron et al. 2022 (mip-NeRF 360), arXiv:2111.12077, equation 15.
    """
    lengths = jnp.diff(edges)
    gaps = (lengths[:-1] + lengths[1:]) / 2
    # Each gap separates the weight before it from the weight behind it. Unlike sums of
    # w_i w_j m_i, which are subtracted elsewhere, all terms have one sign.
    before = jnp.cumsum(weights[:-1])
    behind = jnp.cumsum(weights[:0:-1])[::-1]
    apart = 2 * jnp.sum(gaps * before * behind)
    return apart + jnp.sum(jnp.square(weights) * lengths) / 3
