"""Where the time of a training step goes."""

import jax
import jax.numpy as jnp

from gaussians_jax import render, splats
from gaussians_jax import scene as splat_scene
from gaussians_jax.effects.effect import Moment
from gaussians_jax.scene import Facts, SplatScene
from nerfies_jax.measure import clock
from nerfies_jax.training import losses
from nerfies_jax.training.model import Frames, Model, TrainState

REPEATS = 7


def of_splats(
    spec: SplatScene, facts: Facts, model: Model, state: TrainState, frames: Frames
) -> dict[str, float]:
    """Milliseconds of each part of one step, forward and backward; medians, warm.

    Each part is timed by itself on the first frame. What is left of the whole step is
    the optimiser and the statistics for the density control.
    """
    params = state.params
    size = frames.images.shape[2], frames.images.shape[1]
    camera = jax.tree.map(lambda leaf: leaf[0], frames.cameras)
    truth = frames.images[0].astype(jnp.float32) / 255
    moment = Moment(frames.times[0], state.step, state.key)
    degree = spec.sh_degree

    def draw(gaussians, coefficients):
        frame = render.render_harmonics(
            gaussians, coefficients, camera, size, spec.raster
        )
        return jnp.sum(frame.rendering.colour)

    def compare(colour):
        return losses.photometric(colour, truth, dssim_weight=spec.dssim_weight)

    gaussians = splats.activate(params.rows["splats"])
    coefficients = splats.active_harmonics(params.rows["splats"], degree)
    timed = {
        "project and blend": _ms(jax.grad(draw, (0, 1)), gaussians, coefficients),
        "loss": _ms(jax.grad(compare), truth),
    }
    for effect in splat_scene.effects_of(spec, facts):

        def deform(params, effect=effect):
            gaussians = splats.activate(params.rows["splats"])
            moved = effect.deform(params, gaussians, moment)
            return sum(jnp.sum(leaf) for leaf in moved)

        timed[effect.name.replace("_", " ")] = _ms(jax.grad(deform), params)
    whole = _ms(lambda state: model.step(state, frames), state)
    timed["optimiser and statistics"] = max(whole - sum(timed.values()), 0.0)
    return timed


def _ms(function, *args):
    compiled = jax.jit(function).lower(*args).compile()
    return 1e3 * clock.measure(lambda: compiled(*args), repeats=REPEATS).median
