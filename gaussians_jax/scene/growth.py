"""Events between the chunks of training, which add and remove Gaussians."""

from typing import Any, NamedTuple

import jax
import optax
from jaxtyping import Array, Key

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import Population
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params
from gaussians_jax.scene.spec import SplatScene, strategy_of
from nerfies_jax.training.model import Event, TrainState

PyTree = Any

# Streams of the run's key beside those of the steps, which are its 0, 1, 2, ...
EVENT, NOISE = 2**32 - 2, 2**32 - 3


class AuxState(NamedTuple):
    """State of a scene besides its parameters: statistics, and state of effects."""

    stats: PyTree  # of the strategy; () without one
    effects: dict[str, PyTree]  # by the name of the effect


def states_of(effects: tuple[SplatRecord, ...], params: Params) -> dict[str, PyTree]:
    """Initialize the state of each effect, on the host."""
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
    effects: tuple[SplatRecord, ...],
    optimizer: optax.GradientTransformation,
) -> tuple[Event, ...]:
    """Return when rows are born, die and are reset, and when parameters are projected.

    Args:
      spec: Settings of the scene.
      metadata: Sizes of the capture.
      effects: Parts of the scene.
      optimizer: The optimizer, which knows its state.

    Returns:
      The events of the strategy, and those of the effects behind them.
    """
    strategy = strategy_of(spec, metadata)
    own = () if strategy is None else strategy.events(spec.steps)
    return (
        *(_event(one, strategy, metadata, effects, optimizer) for one in own),
        *(_revision(one, spec.steps) for one in effects if one.revise_at),
    )


def _event(event, strategy, metadata, effects, optimizer):
    def apply(state, frames):
        del frames
        stats, states = state.aux_state
        population = Population(
            state.params,
            state.optimizer,
            stats,
            stream_key(state, EVENT),
            int(state.step),
            metadata.extent,
            optimizer,
        )
        changed = event.apply(population)
        stats = changed.state
        if event.changes_rows:
            stats = strategy.init(changed.params.rows["splats"])
            states = states_of(effects, changed.params)
        return state._replace(
            params=changed.params,
            optimizer=changed.moments,
            aux_state=AuxState(stats, states),
        )

    return Event(event.name, event.steps, apply)


def _revision(effect, steps):
    def revise(state, frames):
        del frames
        own = effect.revise(state.params.nets[effect.name], int(state.step))
        nets = state.params.nets | {effect.name: own}
        return state._replace(params=state.params._replace(nets=nets))

    when = tuple(step for step in effect.revise_at if step < steps)
    return Event(f"revise {effect.name}", when, revise)
