"""Update of the parameters by gradients, and statistics for densification."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from gaussians_jax.core.protocols import MotionParams, StepInfo, Strategy
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Gaussians, Params
from gaussians_jax.optim import learning_rates, phases
from gaussians_jax.optim.phases import Trained
from gaussians_jax.scene import growth
from gaussians_jax.scene.growth import AuxState
from gaussians_jax.scene.spec import SceneMetadata, SplatScene
from gaussians_jax.splatting.projection import Footprints
from nerfies_jax.training.model import TrainState
from nerfies_jax.training.updates import apply_updates


class ViewStatistics(NamedTuple):
    """Statistics of the Gaussians in one frame."""

    mean2d_grad: Float[Array, "rendered 2"]  # of the loss, per pixel
    footprints: Footprints
    canonical: Gaussians  # before the deformation
    deformed: Gaussians  # at the time of the frame
    # Weight of each child in the statistics of its parent. None: all weights are equal.
    significance: Float[Array, " rendered"] | None = None


def descend(
    spec: SplatScene,
    metadata: SceneMetadata,
    effects: tuple[SplatRecord, ...],
    optimizer: optax.GradientTransformation,
    state: TrainState,
    grads: Params,
) -> Trained:
    """Update parameters and optimizer state by one gradient.

    Args:
      spec: Settings of the scene.
      metadata: Metadata of the capture.
      effects: Components of the scene.
      optimizer: The optimizer.
      state: State of the training.
      grads: Gradient of the loss.

    Returns:
      The updated parameters and optimizer state.
    """
    updates, opt_state = optimizer.update(grads, state.optimizer, state.params)
    by_part = _learning_rates(spec, metadata, effects, state.params, state.step)
    new_state = Trained(apply_updates(state.params, updates, by_part), opt_state)
    perturb = getattr(spec.strategy, "perturb", None)
    if perturb is not None:
        key = growth.stream_key(state, growth.NOISE)
        rate = by_part.rows["splats"].mean
        params = perturb(key, new_state.params, rate)
        new_state = new_state._replace(params=params)
    if spec.alternation is not None:
        mask = phases.update_mask(spec.alternation, state.step)
        before = Trained(state.params, state.optimizer)
        new_state = phases.freeze(optimizer, mask, before, new_state)
    return new_state


def observe(
    strategy: Strategy | None,
    aux_state: AuxState,
    statistics: ViewStatistics,
    size: tuple[int, int],
) -> AuxState:
    """Update the state of the strategy by one frame.

    Args:
      strategy: The strategy of the scene, or None.
      aux_state: State of the scene.
      statistics: Statistics of the Gaussians in the frame.
      size: (width, height) of the frame in pixels.

    Returns:
      The updated state of the scene.
    """
    if strategy is None:
        return aux_state
    footprints = statistics.footprints
    info = StepInfo(
        statistics.mean2d_grad,
        footprints.overlaps_image(size),
        jnp.max(footprints.extent_px, axis=1),
        size,
        statistics.canonical,
        statistics.deformed,
        statistics.significance,
    )
    return aux_state._replace(stats=strategy.update(aux_state.stats, info))


def _learning_rates(spec, metadata, effects, params, step):
    """Return a prefix of `Params` with the learning rate of all parameters.

    Rates are multiplied by the square root of the number of views in a step, because
    the mean of their gradients has that much less noise.
    """
    rows = {
        "splats": learning_rates.at_step(
            spec.learning_rates, metadata.extent, spec.steps, step, spec.annealing
        )
    }
    nets = {}
    for effect in effects:
        if effect.init is None:
            continue
        rate = effect.learning_rate(step)
        # A single rate applies to all parameters of the component.
        each = rate if isinstance(rate, MotionParams) else MotionParams(rate, rate)
        if effect.name in params.rows:
            rows[effect.name] = each.per_gaussian
        if effect.name in params.nets:
            nets[effect.name] = each.shared
    rates, root = Params(rows, nets), spec.batch_size**0.5
    return rates if root == 1 else jax.tree.map(lambda rate: root * rate, rates)
