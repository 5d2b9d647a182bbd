"""Penalty on the opacity and the scale of Gaussians, against overfitting.

Kheradmand et al. 2024 (3DGS-MCMC, arXiv:2404.09591), equation 10, for any strategy.
Gaussians that explain little become faint and are pruned, and large faint ones, which
fit the difference between two images, shrink.
"""

import dataclasses
import math

from gaussians_jax.core.metadata import Number, SceneMetadata
from gaussians_jax.core.splats import Params
from gaussians_jax.optim.mcmc import mean_opacity_and_scale
from nerfies_jax.training.effects import PenaltyContext, Term

NAME = "opacity_scale"


@dataclasses.dataclass(frozen=True)
class OpacityScaleSpec:
    """Weights of the mean opacity and of the mean scale in units of the scene extent.

    They are `opacity_reg` and `scale_reg` of gsplat, where the unit is that of the
    scene. 3DGS-MCMC uses 0.01 for both.
    """

    opacity: float = 0.01
    scale: float = 0.01

    def __post_init__(self):
        for name, value in dataclasses.asdict(self).items():
            if not 0 <= value < math.inf:
                raise ValueError(
                    f"{name}={value} must be finite and not negative; 0 disables it"
                )

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the regularizer for this capture."""
        return Bound(self, metadata.extent)


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Regularizer` of an `OpacityScaleSpec`."""

    spec: OpacityScaleSpec
    extent: Number  # of the scene, in scene units

    name = NAME

    def loss(self, params: Params, context: PenaltyContext) -> dict[str, Term]:
        """Compute the mean opacity and the mean scale of the canonical Gaussians."""
        opacity, scale = mean_opacity_and_scale(params.rows["splats"])
        return {
            "opacity": Term(opacity, self.spec.opacity),
            "scale": Term(scale / self.extent, self.spec.scale),
        }
