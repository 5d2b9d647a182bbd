"""What happens between two chunks of a scene's training: its rows grow and die."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Key

from gaussians_jax import densification, mcmc
from gaussians_jax.mcmc import MCMCStrategySpec
from gaussians_jax.spec import SceneMetadata, SplatScene
from gaussians_jax.splats import Params
from nerfies_jax.training.effects import Effect
from nerfies_jax.training.model import Event, TrainState

PyTree = Any

# Streams of the run's key beside those of the steps, which are its 0, 1, 2, ...
EVENT, NOISE = 2**32 - 2, 2**32 - 3


class AuxState(NamedTuple):
    """What a scene keeps beside its parameters: of the rows, and what effects keep."""

    stats: PyTree  # densification.RowStats, or () where no strategy keeps them
    effects: dict[str, PyTree]  # by the name of the effect


def states_of(effects: tuple[Effect, ...], params: Params) -> dict[str, PyTree]:
    """What each effect keeps from this change of the rows to the next; host side."""
    return {
        effect.name: effect.state(params)
        for effect in effects
        if effect.state is not None
    }


def stream_key(state: TrainState, stream: int) -> Key[Array, ""]:
    """A key of this step for something beside `loop.step_key`."""
    return jax.random.fold_in(jax.random.fold_in(state.key, stream), state.step)


def events(
    spec: SplatScene,
    metadata: SceneMetadata,
    effects: tuple[Effect, ...],
    optimizer: optax.GradientTransformation,
) -> tuple[Event, ...]:
    """When rows are born, die and are reset, and effects revise what they learn."""
    revisions = tuple(_revision(effect, spec.steps) for effect in effects
                      if effect.revise is not None)  # fmt: skip
    plan = spec.densification
    if plan is None:
        return revisions
    if isinstance(plan, MCMCStrategySpec):
        return _mcmc_events(plan, spec.steps, effects, optimizer) + revisions
    return _default_events(plan, spec, metadata, effects, optimizer) + revisions


def _revision(effect, steps):
    def revise(state, frames):
        del frames
        own = effect.revise(state.params.nets[effect.name], int(state.step))
        nets = state.params.nets | {effect.name: own}
        return state._replace(params=state.params._replace(nets=nets))

    when = tuple(step for step in effect.revise_at if step < steps)
    return Event(f"revise {effect.name}", when, revise)


def _default_events(plan, spec, metadata, effects, optimizer):
    last = min(plan.refine_stop_iter, spec.steps)

    def densify(state, frames):
        del frames
        stats, states = state.aux_state
        step = int(state.step)
        for effect in effects:
            if effect.grow_score is not None:
                factor = effect.grow_score(states[effect.name], step)
                stats = stats._replace(grad2d=stats.grad2d * jnp.asarray(factor))
        changed = densification.densify(
            optimizer,
            state.params,
            state.optimizer,
            stats,
            stream_key(state, EVENT),
            plan,
            step=step,
            extent=metadata.extent,
        )
        aux_state = AuxState(changed.stats, states_of(effects, changed.params))
        return state._replace(
            params=changed.params, optimizer=changed.moments, aux_state=aux_state
        )

    def reset(state, frames):
        del frames
        params, moments = densification.reset_opacity(
            optimizer, state.params, state.optimizer, plan
        )
        return state._replace(params=params, optimizer=moments)

    grow = tuple(range(plan.refine_start_iter, last, plan.refine_every))
    return (
        Event("densify", grow, densify),
        Event(
            "reset opacity",
            tuple(range(plan.reset_every, last, plan.reset_every)),
            reset,
        ),
    )


def _mcmc_events(plan, steps, effects, optimizer):
    def refine(state, frames):
        del frames
        params, moments, _ = mcmc.refine(
            optimizer, state.params, state.optimizer, stream_key(state, EVENT), plan
        )
        aux_state = AuxState((), states_of(effects, params))
        return state._replace(params=params, optimizer=moments, aux_state=aux_state)

    last = min(plan.refine_stop_iter, steps)
    when = tuple(range(plan.refine_start_iter, last, plan.refine_every))
    return (Event("relocate and add", when, refine),)
