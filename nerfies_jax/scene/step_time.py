"""Time of the parts of a training step of a radiance field."""

import jax

from nerfies_jax.metrics.part_time import StepParts, part
from nerfies_jax.scene import scene
from nerfies_jax.scene import steps as field_steps
from nerfies_jax.training import loop, rate
from nerfies_jax.training.effects import weighted_sum
from nerfies_jax.training.model import Frames, Model, TrainState


def parts(
    spec,
    metadata,
    model: Model,
    state: TrainState,
    frames: Frames,
) -> StepParts:
    """Start to compile the parts of one training step of a radiance field.

    Times are medians of warm calls in milliseconds. Each part is timed separately on a
    micro-batch of rays and multiplied by the number of micro-batches per device and
    step. "rest" is the difference to the time of the whole step.

    Args:
      spec: The scene.
      metadata: Scene metadata.
      model: Its model.
      state: Training state.
      frames: Training frames.

    Returns:
      The parts.
    """
    field = scene.field(spec, metadata)
    batch_key, loss_key = jax.random.split(loop.step_key(state))

    def draw(state, frames, key):
        own = frames.of_part(state.step, 0)
        return field_steps.micro_batch(field, state, own, key)

    batch, guide = jax.jit(draw)(state, frames, batch_key)

    def descend(state, grads):
        return field_steps.descend(spec, field.effects, state, grads)

    def loss(params, frames, batch):
        terms = field_steps.loss_terms(
            field, params, frames, batch, state.step, loss_key, guide
        )
        return weighted_sum(terms)

    programs = {
        "rays": part(draw, state, frames, batch_key),
        "forward": part(loss, state.params, frames, batch),
        "both": part(jax.value_and_grad(loss), state.params, frames, batch),
        "optimizer": part(descend, state, state.params),
    }

    def with_rest(part_ms):
        micro_batches = spec.micro_batches // model.devices
        part_ms |= {
            name: micro_batches * part_ms[name] for name in ("rays", "forward", "both")
        }
        part_ms["backward"] = max(part_ms.pop("both") - part_ms["forward"], 0.0)
        whole = rate.step_ms(model, state, frames, spec.steps)
        return part_ms | {"rest": max(whole - sum(part_ms.values()), 0.0)}

    return StepParts(programs, with_rest)
