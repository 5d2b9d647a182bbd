"""What follows the gradients of a step: an update, and statistics for what grows."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from gaussians_jax import densification, growth, learning_rates, mcmc, phases
from gaussians_jax.densification import DefaultStrategySpec
from gaussians_jax.growth import AuxState
from gaussians_jax.mcmc import MCMCStrategySpec
from gaussians_jax.phases import Trained
from gaussians_jax.projection import Footprints
from gaussians_jax.spec import SceneMetadata, SplatScene
from gaussians_jax.splats import Gaussians, Params
from nerfies_jax.training.effects import Effect, FrameCondition
from nerfies_jax.training.model import TrainState
from nerfies_jax.training.updates import apply_updates


class Drawn(NamedTuple):
    """What one frame showed of the Gaussians."""

    mean2d_grad: Float[Array, "drawn 2"]  # of the loss, per pixel
    footprints: Footprints
    canonical: Gaussians  # the rows
    moved: Gaussians  # the rows as they stood at the frame's time
    # How much each of what was drawn counts for its row; None: all alike.
    significance: Float[Array, " drawn"] | None = None


def descend(
    spec: SplatScene,
    metadata: SceneMetadata,
    effects: tuple[Effect, ...],
    optimizer: optax.GradientTransformation,
    state: TrainState,
    grads: Params,
) -> Trained:
    """Parameters and moments after one update along `grads`."""
    updates, opt_state = optimizer.update(grads, state.optimizer, state.params)
    by_part = _learning_rates(spec, metadata, effects, state.step)
    trained = Trained(apply_updates(state.params, updates, by_part), opt_state)
    if isinstance(spec.densification, MCMCStrategySpec):
        noise_key = growth.stream_key(state, growth.NOISE)
        rate = by_part.rows["splats"].mean
        params = mcmc.inject_noise(noise_key, trained.params, rate, spec.densification)
        trained = trained._replace(params=params)
    if spec.alternation is not None:
        mask = phases.update_mask(spec.alternation, state.step)
        before = Trained(state.params, state.optimizer)
        trained = phases.freeze(optimizer, mask, before, trained)
    return trained


def has_statistics(spec: SplatScene, effects: tuple[Effect, ...]) -> bool:
    """Whether a step gathers any."""
    own = any(effect.update_state is not None for effect in effects)
    return own or isinstance(spec.densification, DefaultStrategySpec)


def gather(
    spec: SplatScene,
    effects: tuple[Effect, ...],
    aux_state: AuxState,
    drawn: Drawn,
    condition: FrameCondition,
    size: tuple[int, int],
) -> AuxState:
    """Statistics for the density control and of the effects, with one more frame.

    `size` is that of the frame, (width, height) in pixels.
    """
    stats, states = aux_state
    if isinstance(spec.densification, DefaultStrategySpec):
        footprints = drawn.footprints
        radius_px = jnp.max(footprints.extent_px, axis=1)
        stats = densification.observe(
            stats,
            drawn.mean2d_grad,
            footprints.seen(size),
            radius_px,
            size,
            drawn.significance,
        )
    for effect in effects:
        if effect.update_state is not None:
            own = effect.update_state(
                states[effect.name], drawn.canonical, drawn.moved, condition
            )
            states = states | {effect.name: own}
    return AuxState(stats, states)


def _learning_rates(spec, metadata, effects, step):
    """A prefix of `Params` with the learning rate of everything below each leaf.

    Times the root of the views in a step: their mean is that much less noisy.
    """
    rows = {
        "splats": learning_rates.at_step(
            spec.learning_rates, metadata.extent, spec.steps, step, spec.annealing
        )
    }
    nets = {}
    for effect in effects:
        if effect.init_rows is not None:
            rows[effect.name] = effect.row_learning_rate(step)
        if effect.init is not None:
            nets[effect.name] = effect.learning_rate(step)
    rates, root = Params(rows, nets), spec.batch_size**0.5
    return rates if root == 1 else jax.tree.map(lambda rate: root * rate, rates)
