"""Where the time of a training step of a radiance field goes."""

import jax

from nerfies_jax import scene
from nerfies_jax.measure.part_time import part_ms
from nerfies_jax.training import loop, rate
from nerfies_jax.training.effects import Effect, weighted_sum
from nerfies_jax.training.model import Frames, Model, TrainState


def parts(
    spec,
    metadata,
    model: Model,
    state: TrainState,
    frames: Frames,
    effects: tuple[Effect, ...] = (),
) -> dict[str, float]:
    """Milliseconds of each part of one step of a radiance field; medians, warm.

    "rest" is what the parts, each timed by itself, leave of the whole step.
    """
    field = scene.field(spec, metadata, effects=effects)
    batch_key, loss_key = jax.random.split(loop.step_key(state))
    rays = spec.rays // model.devices  # that a device takes
    batch = jax.jit(scene.draw_batch, static_argnums=1)(frames, rays, batch_key)

    def draw(frames, key):
        return scene.draw_batch(frames, rays, key)

    def descend(state, grads):
        return scene.descend(spec, field.effects, state, grads)

    guide = None if spec.sampling.occupancy is None else state.aux_state

    def loss(params, frames, batch):
        terms = scene.loss_terms(
            field, params, frames, batch, state.step, loss_key, guide
        )
        return weighted_sum(terms)

    forward = part_ms(loss, state.params, frames, batch)
    both = part_ms(jax.value_and_grad(loss), state.params, frames, batch)
    timed = {
        "rays": part_ms(draw, frames, batch_key),
        "forward": forward,
        "backward": max(both - forward, 0.0),
        "optimiser": part_ms(descend, state, state.params),
    }
    whole = rate.step_ms(model, state, frames, spec.steps)
    return timed | {"rest": max(whole - sum(timed.values()), 0.0)}
