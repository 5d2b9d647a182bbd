"""Time of the parts of a training step of Gaussians."""

import jax
import jax.numpy as jnp

from gaussians_jax.core import splats
from gaussians_jax.motion import deformation
from gaussians_jax.scene import scene, update
from gaussians_jax.scene.spec import optimizer_of, raster_of, strategy_of
from gaussians_jax.scene.update import Drawn
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

    Their times are medians of warm calls, in milliseconds, each part timed by itself on
    the first frame and one device, and counted for as many views as a device draws in a
    step. "rest" is what they leave of the whole step.
    """
    effects = scene.all_effects(spec, metadata)
    condition = FrameCondition(frames.times[0], step=state.step, key=state.key)

    @jax.jit
    def drawn(params):
        still = splats.activate(params.rows["splats"])
        return deformation.drawn(effects, params, still, condition)

    now = drawn(state.params)
    a_view = _drawing(spec, metadata, effects, now, frames)
    a_view |= _own_of_effects(effects, state, frames, condition)
    once = _update(spec, metadata, effects, state, now, frames)
    views = spec.batch_size // model.devices

    def with_rest(timed):
        timed |= {name: views * timed[name] for name in a_view}
        whole = rate.step_ms(model, state, frames, spec.steps)
        return timed | {"rest": max(whole - sum(timed.values()), 0.0)}

    return StepParts(a_view | once, with_rest)


def _drawing(spec, metadata, effects, now, frames):
    """The picture of the rows and Gaussians of the moment, and its loss."""
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

    rows, gaussians = now
    coefficients = splats.active_harmonics(rows, spec.sh_degree)
    args = gaussians, coefficients, jnp.zeros_like(gaussians.mean[:, :2])
    return {
        "project and blend": part(jax.grad(draw, (0, 1, 2)), *args),
        "loss": part(jax.grad(compare), observation.truth),
    }


def _own_of_effects(effects, state, frames, condition):
    """Each effect that deforms or penalizes."""
    observation, parts = scene.observe(frames, 0, None), {}
    drawn = Rendering(
        observation.truth, *(jnp.ones(observation.truth.shape[:2]) for _ in "ad")
    )
    for effect in effects:
        # The step is an input, too: a warm-up that is compiled in costs nothing.
        def one(params, rendering, kept, condition, effect=effect):
            seen = observation._replace(rendering=rendering)
            return _sum_of_effect(effect, effects, params, seen, condition, kept)

        if {effect.deform, effect.derive, effect.penalty} != {None}:
            kept = state.aux_state.effects.get(effect.name)
            grads = jax.grad(one, (0, 1))
            name = effect.name.replace("_", " ")
            parts[name] = part(grads, state.params, drawn, kept, condition)
    return parts


def _update(spec, metadata, effects, state, now, frames):
    """Apply the update that follows the gradient, with parameters as stand-in
    gradients.
    """
    optimizer = optimizer_of(spec)

    def descend(state, grads):
        return update.descend(spec, metadata, effects, optimizer, state, grads)

    strategy = strategy_of(spec, metadata)

    def gather(aux_state, *drawn):
        return update.observed(strategy, aux_state, Drawn(*drawn), _size(frames))

    parts = {"optimizer": part(descend, state, state.params)}
    if jax.tree.leaves(state.aux_state.stats):
        footprints = jax.eval_shape(
            lambda *seen: projection.project(
                *seen, _size(frames), raster_of(spec, metadata)
            ),
            now[1],
            _first_camera(frames),
        )
        # What they take is the same for any values.
        footprints = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), footprints)
        still = splats.activate(state.params.rows["splats"])
        slope = deformation.probe(effects, state.params)
        parts["statistics"] = part(
            gather, state.aux_state, slope, footprints, still, still
        )
    return parts


def _first_camera(frames):
    return jax.tree.map(lambda leaf: leaf[0], frames.cameras)


def _size(frames):
    return frames.images.shape[2], frames.images.shape[1]


def _sum_of_effect(effect, effects, params, observation, condition, state):
    """A scalar whose gradient takes the work of one effect in a step."""
    total = jnp.zeros(())
    if effect.deform is not None:
        gaussians = splats.activate(params.rows["splats"])
        moved = deformation.deform_in_training(
            (effect,), params, gaussians, condition, {effect.name: state}
        )
        total += sum(jnp.sum(leaf) for leaf in moved)
    if effect.derive is not None:
        still = splats.activate(params.rows["splats"])
        rows, drawn = deformation.drawn((effect,), params, still, condition)
        total += sum(jnp.sum(leaf) for leaf in (*rows, *drawn))
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
