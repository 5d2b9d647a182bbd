"""Events between the chunks of training: densification and projection steps."""

from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from jaxtyping import Array, Key

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import Population
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params
from gaussians_jax.scene.spec import SplatScene, strategy_of
from nerfies_jax.training.model import Event, TrainState

PyTree = Any

# Streams of the run's PRNG key, apart from those of the steps, which are 0, 1, 2, ...
EVENT, NOISE = 2**32 - 2, 2**32 - 3


class AuxState(NamedTuple):
    """State of a scene besides its parameters."""

    stats: PyTree  # state of the strategy, () without one
    effects: dict[str, PyTree]  # state of each component, by name


def states_of(effects: tuple[SplatRecord, ...], params: Params) -> dict[str, PyTree]:
    """Initialize the state of each component, on the host.

    Args:
      effects: The components.
      params: Initial parameters.

    Returns:
      States by the names of the components that have one.
    """
    return {
        effect.name: effect.state(params)
        for effect in effects
        if effect.state is not None
    }


def stream_key(state: TrainState, stream: int) -> Key[Array, ""]:
    """Return a PRNG key of this step that is independent of `loop.step_key`.

    Args:
      state: State of training.
      stream: Number of the stream.

    Returns:
      The key.
    """
    return _fold_in_both(state.key, np.uint32(stream), state.step)


@jax.jit
def _fold_in_both(key, stream, step):
    return jax.random.fold_in(jax.random.fold_in(key, stream), step)


def events(
    spec: SplatScene,
    metadata: SceneMetadata,
    effects: tuple[SplatRecord, ...],
    optimizer: optax.GradientTransformation,
) -> tuple[Event, ...]:
    """Return the events of the strategy and the projection steps of a scene.

    Args:
      spec: Settings of the scene.
      metadata: Metadata of the capture.
      effects: Components of the scene.
      optimizer: The optimizer.

    Returns:
      The events of the strategy, followed by those of the components.
    """
    strategy = strategy_of(spec, metadata)
    densification = () if strategy is None else strategy.events(spec.steps)
    return (
        *(_event(e, strategy, metadata, effects, optimizer) for e in densification),
        *(_revision(effect, spec.steps) for effect in effects if effect.revise_at),
    )


def _event(event, strategy, metadata, effects, optimizer):
    def apply(state, frames):
        stats, states = state.aux_state
        population = Population(
            state.params,
            state.optimizer,
            stats,
            stream_key(state, EVENT),
            int(state.step),
            metadata.extent,
            optimizer,
            frames,
        )
        new_population = event.apply(population)
        stats = new_population.state
        if event.changes_rows:
            stats = strategy.init(new_population.params.rows["splats"])
            states = states_of(effects, new_population.params)
        return state._replace(
            params=new_population.params,
            optimizer=new_population.moments,
            aux_state=AuxState(stats, states),
        )

    return Event(event.name, event.steps, apply)


def _revision(effect, steps):
    def revise(state, frames):
        del frames
        new_net = effect.revise(state.params.nets[effect.name], int(state.step))
        nets = state.params.nets | {effect.name: new_net}
        return state._replace(params=state.params._replace(nets=nets))

    when = tuple(step for step in effect.revise_at if step < steps)
    return Event(f"revise {effect.name}", when, revise)
