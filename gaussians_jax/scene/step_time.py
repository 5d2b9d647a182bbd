"""Time of the parts of a training step of Gaussians."""

import jax
import jax.numpy as jnp

from gaussians_jax.core import splats
from gaussians_jax.motion import deformation
from gaussians_jax.scene import scene, update
from gaussians_jax.scene.spec import optimizer_of, raster_of, strategy_of
from gaussians_jax.scene.update import ViewStatistics
from gaussians_jax.splatting import projection, rendering
from nerfies_jax.metrics.part_time import StepParts, part
from nerfies_jax.training import losses, rate
from nerfies_jax.training.effects import (
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
) -> StepParts:
    """Begin to compile the parts of one step, forward and backward.

    Times are medians of warm calls in milliseconds. Each part is timed separately on
    the first frame and one device, and multiplied by the number of views per device and
    step, also if several devices share the image of one view. "rest" is the remainder
    of the whole step.

    Args:
      spec: The scene.
      metadata: Scene metadata.
      model: The model.
      state: Trained state.
      frames: Training frames on the device.

    Returns:
      The parts.
    """
    effects = scene.all_effects(spec, metadata)
    condition = FrameCondition(frames.times[0], step=state.step, key=state.key)

    @jax.jit
    def render(params):
        canonical = splats.activate(params.rows["splats"])
        return deformation.rendered(effects, params, canonical, condition)

    rows_and_gaussians = render(state.params)
    per_view = _drawing(spec, metadata, effects, rows_and_gaussians, frames)
    per_view |= _components(effects, state, frames, condition)
    per_step = _update(spec, metadata, effects, state, rows_and_gaussians, frames)
    views = max(spec.batch_size // model.devices, 1)

    def with_rest(times):
        times |= {name: views * times[name] for name in per_view}
        total = rate.step_ms(model, state, frames, spec.steps)
        return times | {"rest": max(total - sum(times.values()), 0.0)}

    return StepParts(per_view | per_step, with_rest)


def _drawing(spec, metadata, effects, rows_and_gaussians, frames):
    """Return the rendering of the current Gaussians, and its loss."""
    observation = scene.observe(frames, 0, None)
    camera = _first_camera(frames)

    def draw(gaussians, coefficients, probe):
        frame = rendering.render_harmonics(
            gaussians,
            coefficients,
            camera,
            _size(frames),
            raster_of(spec, metadata),
            mean2d_offset=probe,
            depth=scene.draws_depth(effects, frames),
        )
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(frame.rendering))

    def compare(color):
        return losses.photometric(
            color, observation.truth, observation.valid, dssim_weight=spec.dssim_weight
        )

    rows, gaussians = rows_and_gaussians
    coefficients = splats.active_harmonics(rows, spec.sh_degree)
    args = gaussians, coefficients, jnp.zeros_like(gaussians.mean[:, :2])
    return {
        "project and blend": part(jax.grad(draw, (0, 1, 2)), *args),
        "loss": part(jax.grad(compare), observation.truth),
    }


def _components(effects, state, frames, condition):
    """Return the work of each component that deforms Gaussians or adds to the loss."""
    observation, parts = scene.observe(frames, 0, None), {}
    frame_rendering = Rendering(
        observation.truth, *(jnp.ones(observation.truth.shape[:2]) for _ in "ad")
    )
    for effect in effects:
        # The step is an input, because a compiled-in warm-up would cost nothing.
        def value(params, rendering, component_state, condition, effect=effect):
            frame_observation = observation._replace(rendering=rendering)
            return _sum_of_effect(
                effect, effects, params, frame_observation, condition, component_state
            )

        if {effect.deform, effect.derive, effect.penalty} != {None}:
            component_state = state.aux_state.effects.get(effect.name)
            grads = jax.grad(value, (0, 1))
            name = effect.name.replace("_", " ")
            parts[name] = part(
                grads, state.params, frame_rendering, component_state, condition
            )
    return parts


def _update(spec, metadata, effects, state, rows_and_gaussians, frames):
    """Return the optimizer update and the statistics, with stand-in gradients."""
    optimizer = optimizer_of(spec)

    def descend(state, grads):
        return update.descend(spec, metadata, effects, optimizer, state, grads)

    strategy = strategy_of(spec, metadata)

    def gather(aux_state, *statistics):
        return update.observe(
            strategy, aux_state, ViewStatistics(*statistics), _size(frames)
        )

    parts = {"optimizer": part(descend, state, state.params)}
    if jax.tree.leaves(state.aux_state.stats):
        footprints = jax.eval_shape(
            lambda *args: projection.project(
                *args, _size(frames), raster_of(spec, metadata)
            ),
            rows_and_gaussians[1],
            _first_camera(frames),
        )
        # The time does not depend on the values.
        footprints = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), footprints)
        canonical = splats.activate(state.params.rows["splats"])
        gradient = deformation.probe(effects, state.params)
        parts["statistics"] = part(
            gather, state.aux_state, gradient, footprints, canonical, canonical
        )
    return parts


def _first_camera(frames):
    return jax.tree.map(lambda leaf: leaf[0], frames.cameras)


def _size(frames):
    return frames.images.shape[2], frames.images.shape[1]


def _sum_of_effect(effect, effects, params, observation, condition, state):
    """Compute a scalar whose gradient takes the work of one component in a step."""
    total = jnp.zeros(())
    if effect.deform is not None:
        gaussians = splats.activate(params.rows["splats"])
        at_frame = deformation.deform_in_training(
            (effect,), params, gaussians, condition, {effect.name: state}
        )
        total += sum(jnp.sum(leaf) for leaf in at_frame)
    if effect.derive is not None:
        canonical = splats.activate(params.rows["splats"])
        rows, rendered_gaussians = deformation.rendered(
            (effect,), params, canonical, condition
        )
        total += sum(jnp.sum(leaf) for leaf in (*rows, *rendered_gaussians))
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
