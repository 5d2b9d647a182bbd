"""Where the time of a training step of Gaussians goes."""

import jax
import jax.numpy as jnp

from gaussians_jax import rendering, scene, splats
from gaussians_jax.effects import deformation
from nerfies_jax.measure.part_time import part_ms
from nerfies_jax.training import losses
from nerfies_jax.training.effects import (
    Effect,
    FrameCondition,
    PenaltyContext,
    penalty_terms,
    weighted_sum,
)
from nerfies_jax.training.model import Frames, Model, Rendering, TrainState


def parts(
    spec,
    metadata,
    model: Model,
    state: TrainState,
    frames: Frames,
    effects: tuple[Effect, ...] = (),
) -> dict[str, float]:
    """Milliseconds of each part of one step, forward and backward; medians, warm.

    Each part is timed by itself on the first frame. What is left of the whole step is
    the optimiser and the statistics for the density control.
    """
    params = state.params
    size = frames.images.shape[2], frames.images.shape[1]
    camera = jax.tree.map(lambda leaf: leaf[0], frames.cameras)
    observation = scene.observe(frames, 0, None)
    condition = FrameCondition(frames.times[0], step=state.step, key=state.key)
    effects = scene.all_effects(spec, metadata, effects)

    def draw(gaussians, coefficients):
        frame = rendering.render_harmonics(
            gaussians, coefficients, camera, size, spec.raster
        )
        return jnp.sum(frame.rendering.colour)

    def compare(colour):
        return losses.photometric(
            colour, observation.truth, observation.valid, dssim_weight=spec.dssim_weight
        )

    gaussians = splats.activate(params.rows["splats"])
    coefficients = splats.active_harmonics(params.rows["splats"], spec.sh_degree)
    timed = {
        "project and blend": part_ms(jax.grad(draw, (0, 1)), gaussians, coefficients),
        "loss": part_ms(jax.grad(compare), observation.truth),
    }
    for effect in effects:

        def one(params, rendering, state, effect=effect):
            return _sum_of_effect(
                effect,
                effects,
                params,
                observation._replace(rendering=rendering),
                condition,
                state,
            )

        kept = state.aux_state.effects.get(effect.name)
        drawn = Rendering(
            observation.truth, *(jnp.ones(observation.truth.shape[:2]) for _ in "ad")
        )
        if {effect.deform, effect.penalty} != {None}:
            grads = jax.grad(one, (0, 1))
            timed[effect.name.replace("_", " ")] = part_ms(grads, params, drawn, kept)
    whole = part_ms(model.step, state, frames)
    timed["optimiser and statistics"] = max(whole - sum(timed.values()), 0.0)
    return timed


def _sum_of_effect(effect, effects, params, observation, condition, state):
    """A scalar whose gradient takes the work of one effect in a step."""
    total = jnp.zeros(())
    if effect.deform is not None:
        gaussians = splats.activate(params.rows["splats"])
        moved = deformation.deform_in_training((effect,), params, gaussians, condition)
        total += sum(jnp.sum(leaf) for leaf in moved)
    context = PenaltyContext(
        condition=condition,
        step=condition.step,
        key=condition.key,
        params=params,
        observation=observation,
        at_time=deformation.deformer(effects, condition),
    )
    states = {effect.name: state}
    return weighted_sum(penalty_terms((effect,), params.nets, context, states), total)
