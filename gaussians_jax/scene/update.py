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


class Drawn(NamedTuple):
    """Observation of the Gaussians in one frame."""

    mean2d_grad: Float[Array, "drawn 2"]  # of the loss, per pixel
    footprints: Footprints
    canonical: Gaussians  # the rows
    moved: Gaussians  # the rows as they stood at the frame's time
    # How much each of what was drawn counts for its row; None: all alike.
    significance: Float[Array, " drawn"] | None = None


def descend(
    spec: SplatScene,
    metadata: SceneMetadata,
    effects: tuple[SplatRecord, ...],
    optimizer: optax.GradientTransformation,
    state: TrainState,
    grads: Params,
) -> Trained:
    """Parameters and moments after one update along `grads`."""
    updates, opt_state = optimizer.update(grads, state.optimizer, state.params)
    by_part = _learning_rates(spec, metadata, effects, state.params, state.step)
    trained = Trained(apply_updates(state.params, updates, by_part), opt_state)
    perturb = getattr(spec.strategy, "perturb", None)
    if perturb is not None:
        key = growth.stream_key(state, growth.NOISE)
        rate = by_part.rows["splats"].mean
        params = perturb(key, trained.params, rate)
        trained = trained._replace(params=params)
    if spec.alternation is not None:
        mask = phases.update_mask(spec.alternation, state.step)
        before = Trained(state.params, state.optimizer)
        trained = phases.freeze(optimizer, mask, before, trained)
    return trained


def observed(
    strategy: Strategy | None,
    aux_state: AuxState,
    drawn: Drawn,
    size: tuple[int, int],
) -> AuxState:
    """Return the state of the strategy after one more frame.

    Args:
      strategy: Control of the number of Gaussians; None: there is none.
      aux_state: State of the scene.
      drawn: Observation of the Gaussians in the frame.
      size: (width, height) of the frame in pixels.
    """
    if strategy is None:
        return aux_state
    footprints = drawn.footprints
    info = StepInfo(
        drawn.mean2d_grad,
        footprints.seen(size),
        jnp.max(footprints.extent_px, axis=1),
        size,
        drawn.canonical,
        drawn.moved,
        drawn.significance,
    )
    return aux_state._replace(stats=strategy.update(aux_state.stats, info))


def _learning_rates(spec, metadata, effects, params, step):
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
        if effect.init is None:
            continue
        own = effect.learning_rate(step)
        # A single number is the rate of all its parameters.
        each = own if isinstance(own, MotionParams) else MotionParams(own, own)
        if effect.name in params.rows:
            rows[effect.name] = each.per_gaussian
        if effect.name in params.nets:
            nets[effect.name] = each.shared
    rates, root = Params(rows, nets), spec.batch_size**0.5
    return rates if root == 1 else jax.tree.map(lambda rate: root * rate, rates)
