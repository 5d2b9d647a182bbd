"""Learning rates of what a scene of Gaussians trains, one for each kind of row."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from gaussians_jax.effects.effect import Effect
from gaussians_jax.splats import Params, Splats


@dataclasses.dataclass(frozen=True)
class RateSpec:
    """Adam's learning rates: the defaults of Kerbl et al. 2023, reference code.

    Means learn in units of the scene's extent, decaying log-linearly over the run.
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
                    f"a learning rate is finite and not negative, got "
                    f"{field.name}={value}"
                )
        if self.mean_end <= 0 < self.mean:
            raise ValueError(
                f"a log-linear decay cannot end at mean_end={self.mean_end}; "
                "choose a small positive rate"
            )


def log_linear(
    step: Int[Array, ""], first: float, last: float, steps: int
) -> Float[Array, ""]:
    """From `first` to `last` in equal ratios over `steps` updates, then constant."""
    schedule = optax.exponential_decay(
        first, transition_steps=steps, decay_rate=last / first, end_value=last
    )
    return jnp.asarray(schedule(step))


def learning_rates(
    spec: RateSpec,
    effects: tuple[Effect, ...],
    extent: float,
    steps: int,
    step: Int[Array, ""],
) -> Params:
    """A prefix of `Params` with one rate for each kind of leaf, at a traced step."""
    if spec.mean > 0:
        mean = extent * log_linear(step, spec.mean, spec.mean_end, steps)
    else:
        mean = 0.0
    rows = {
        "splats": Splats(
            mean=mean,
            log_scale=spec.log_scale,
            quaternion=spec.quaternion,
            opacity_logit=spec.opacity_logit,
            sh_dc=spec.sh_dc,
            sh_rest=spec.sh_rest,
        )
    }
    nets = {}
    for effect in effects:
        if effect.init_rows is not None:
            rows[effect.name] = effect.learning_rate(step)
        if effect.init_nets is not None:
            nets[effect.name] = effect.learning_rate(step)
    return Params(rows, nets)


def descend(params: Params, directions: Params, rates: Params) -> Params:
    """`params - rate * direction`, each rate shared by the leaves below it."""

    def below(rate, parameters, along):
        def move(parameter, direction):
            rate_here = jnp.asarray(rate, parameter.dtype)
            return parameter - rate_here * direction.astype(parameter.dtype)

        return jax.tree.map(move, parameters, along)

    return jax.tree.map(below, rates, params, directions)
