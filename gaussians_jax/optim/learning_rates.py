"""Learning rates of per-Gaussian parameters."""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Int

from gaussians_jax.core.metadata import Number
from gaussians_jax.core.splats import Splats
from gaussians_jax.optim import phases
from gaussians_jax.optim.phases import AnnealingSpec
from nerfies_jax.training import schedules


@dataclasses.dataclass(frozen=True)
class LearningRateSpec:
    """Adam's learning rates: the defaults of Kerbl et al. 2023, reference code.

    Rates of means are in units of the scene's extent and decay log-linearly.
    """

    mean: float = 1.6e-4
    mean_end: float = 1.6e-6
    log_scale: float = 5e-3
    quaternion: float = 1e-3
    opacity_logit: float = 5e-2
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(
                    f"a learning rate must be finite and not negative, got "
                    f"{field.name}={value}"
                )
        if self.mean_end <= 0 < self.mean:
            raise ValueError(
                f"a log-linear decay cannot end at mean_end={self.mean_end}; "
                "choose a small positive rate"
            )


def at_step(
    spec: LearningRateSpec,
    extent: Number,
    steps: int,
    step: Int[Array, ""],
    annealing: AnnealingSpec | None = None,
) -> Splats:
    """Compute the learning rates at a step.

    Args:
      spec: Settings.
      extent: Scene extent (`splats.scene_extent`), the unit of the rate of the means.
      steps: Total number of steps.
      step: Traced step.
      annealing: Settings of the annealing of positions.

    Returns:
      One rate for each per-Gaussian parameter.
    """
    if spec.mean > 0:
        decay = schedules.log_linear(spec.mean, spec.mean_end, steps)
        if annealing is not None:
            decay = phases.annealed(decay, annealing, steps)
        mean = extent * decay(step)
    else:
        mean = jnp.zeros(())
    rates: dict[str, Any] = dict(
        mean=mean,
        log_scale=spec.log_scale,
        quaternion=spec.quaternion,
        opacity_logit=spec.opacity_logit,
        sh_dc=spec.sh_dc,
        sh_rest=spec.sh_rest,
    )
    return Splats(**rates)
