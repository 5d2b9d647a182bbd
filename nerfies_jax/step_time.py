"""Where the time of a training step of a radiance field goes."""

from collections.abc import Callable

import jax

from nerfies_jax import scene
from nerfies_jax.measure.part_time import part, parts_ms
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
) -> Callable[[], dict[str, float]]:
    """Begin to compile the parts of one step of a radiance field.

    The call times them, once all are there: milliseconds, medians, warm. "rest" is what
    the parts, each timed by itself, leave of the whole step.
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

    programs = {
        "rays": part(draw, frames, batch_key),
        "forward": part(loss, state.params, frames, batch),
        "both": part(jax.value_and_grad(loss), state.params, frames, batch),
        "optimiser": part(descend, state, state.params),
    }

    def time_parts():
        timed = parts_ms(programs)
        timed["backward"] = max(timed.pop("both") - timed["forward"], 0.0)
        whole = rate.step_ms(model, state, frames, spec.steps)
        return timed | {"rest": max(whole - sum(timed.values()), 0.0)}

    return time_parts
