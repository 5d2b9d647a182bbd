"""Where the time of a training step goes."""

import jax
import jax.numpy as jnp

from nerfies_jax.measure import clock
from nerfies_jax.training import loop, losses
from nerfies_jax.training.model import Frames, Model, Rendering, TrainState

REPEATS = 7
PART_SECONDS = 5.0  # for the repeats of one part: a step of a large field takes longer


def of_splats(
    spec, facts, model: Model, state: TrainState, frames: Frames
) -> dict[str, float]:
    """Milliseconds of each part of one step, forward and backward; medians, warm.

    Each part is timed by itself on the first frame. What is left of the whole step is
    the optimiser and the statistics for densification.
    """
    from gaussians_jax import render, scene, splats
    from gaussians_jax.effects.effect import Moment

    params = state.params
    size = frames.images.shape[2], frames.images.shape[1]
    camera = jax.tree.map(lambda leaf: leaf[0], frames.cameras)
    shot = scene.shot(frames, 0, None)
    moment = Moment(frames.times[0], state.step, state.key)
    effects = scene.effects_of(spec, facts)

    def draw(gaussians, coefficients):
        frame = render.render_harmonics(
            gaussians, coefficients, camera, size, spec.raster
        )
        return jnp.sum(frame.rendering.colour)

    def compare(colour):
        return losses.photometric(
            colour, shot.truth, shot.valid, dssim_weight=spec.dssim_weight
        )

    gaussians = splats.activate(params.rows["splats"])
    coefficients = splats.active_harmonics(params.rows["splats"], spec.sh_degree)
    timed = {
        "project and blend": _ms(jax.grad(draw, (0, 1)), gaussians, coefficients),
        "loss": _ms(jax.grad(compare), shot.truth),
    }
    for effect in effects:

        def one(params, rendering, carried, effect=effect):
            return _sum_of_effect(
                effect,
                effects,
                params,
                shot._replace(rendering=rendering),
                moment,
                carried,
            )

        carried = state.extra.carried.get(effect.name)
        drawn = Rendering(shot.truth, *(jnp.ones(shot.truth.shape[:2]) for _ in "ad"))
        if {effect.deform, effect.image_loss, effect.penalty} != {None}:
            slope = jax.grad(one, (0, 1))
            timed[effect.name.replace("_", " ")] = _ms(slope, params, drawn, carried)
    whole = _ms(model.step, state, frames)
    timed["optimiser and statistics"] = max(whole - sum(timed.values()), 0.0)
    return timed


def _sum_of_effect(effect, effects, params, shot, moment, carried):
    """A scalar whose gradient takes the work of one effect in a step."""
    from gaussians_jax import splats
    from gaussians_jax.effects import deformation
    from gaussians_jax.effects.effect import Around

    total = jnp.zeros(())
    if effect.deform is not None:
        gaussians = splats.activate(params.rows["splats"])
        moved = deformation.pose_in_training((effect,), params, gaussians, moment)
        total += sum(jnp.sum(leaf) for leaf in moved)
    if effect.image_loss is not None:
        total += effect.image_loss(params, shot, moment).value
    if effect.penalty is not None:
        at_time = deformation.poser(effects, moment)
        total += effect.penalty(Around(params, at_time, moment, carried)).value
    return total


def of_fields(
    spec, facts, model: Model, state: TrainState, frames: Frames
) -> dict[str, float]:
    """Milliseconds of each part of one step of a radiance field; medians, warm."""
    from nerfies_jax import scene

    made = scene.field(spec, facts)
    batch_key, loss_key = jax.random.split(loop.step_key(state))
    batch = jax.jit(scene.draw_batch, static_argnums=1)(frames, spec.rays, batch_key)

    def loss(params, frames, batch):
        terms = scene.loss_terms(
            spec, facts, made, params, frames, batch, state.step, loss_key
        )
        return sum(term.weight * term.value for term in terms.values())

    forward = _ms(loss, state.params, frames, batch)
    both = _ms(jax.value_and_grad(loss), state.params, frames, batch)
    whole = _ms(model.step, state, frames)
    return {
        "forward": forward,
        "backward": max(both - forward, 0.0),
        "rays and optimiser": max(whole - both, 0.0),
    }


def _ms(function, *args):
    """Median milliseconds of a call; arrays are inputs, not constants to compile in."""
    compiled = jax.jit(function).lower(*args).compile()

    def call():
        return compiled(*args)

    first = clock.measure(call, repeats=1, warm_up=0).median
    repeats = min(REPEATS, int(PART_SECONDS / first))
    if repeats < 2:
        return 1e3 * first
    return 1e3 * clock.measure(call, repeats=repeats, warm_up=0).median
