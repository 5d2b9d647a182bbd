"""Penalty on the curvature of the rendered surfaces, for views between the captured.

Inverse depth is linear in the pixels of a plane, so its second differences vanish on
flat surfaces at any angle. Their absolute values are averaged, which leaves isolated
depth edges alone.
"""

import dataclasses
import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from gaussians_jax.core.metadata import Number, SceneMetadata
from gaussians_jax.core.splats import Params
from nerfies_jax.training.effects import PenaltyContext, Term

NAME = "smooth_depth"
OPAQUE = 0.5  # pixels with less opacity have no reliable depth


@dataclasses.dataclass(frozen=True)
class SmoothDepthSpec:
    """Weight of the mean curvature of relative inverse depth, per squared pixel."""

    weight: float = 0.1

    def __post_init__(self):
        if not 0 <= self.weight < math.inf:
            raise ValueError(
                f"weight={self.weight} must be finite and not negative; leave the loss "
                "out to disable it"
            )

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the regularizer for this capture."""
        return Bound(self, metadata.depth)


def curvature(
    depth: Float[Array, "height width"], alpha: Float[Array, "height width"]
) -> Float[Array, ""]:
    """Compute the mean absolute second difference of inverse depth along both axes.

    Args:
      depth: Rendered z-depth, positive where anything was rendered.
      alpha: Rendered opacity.

    Returns:
      The mean over all pixels, in units of the inverse of `depth`. Differences that
      touch a pixel with an opacity below `OPAQUE` count as zero.
    """
    valid = (alpha >= OPAQUE) & (depth > 0)
    inverse = jnp.where(valid, 1 / jnp.where(valid, depth, 1), 0)

    def along(values, valid):
        bend = values[2:] - 2 * values[1:-1] + values[:-2]
        all_valid = valid[2:] & valid[1:-1] & valid[:-2]
        return jnp.sum(jnp.where(all_valid, jnp.abs(bend), 0))

    total = along(inverse, valid) + along(inverse.T, valid.T)
    return total / depth.size


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Regularizer` of a `SmoothDepthSpec`."""

    spec: SmoothDepthSpec
    depth: Number  # typical depth, in scene units

    name = NAME
    reads_depth = True

    def loss(self, params: Params, context: PenaltyContext) -> dict[str, Term]:
        """Compute the curvature of one rendered frame."""
        assert context.observation is not None
        rendering = context.observation.rendering
        assert rendering is not None
        assert rendering.depth is not None
        value = self.depth * curvature(rendering.depth, rendering.alpha)
        return {"curvature": Term(value, self.spec.weight)}
