"""Codes of held-out photographs, fitted to one half of each.

This is the protocol of NeRF-W (Martin-Brualla et al. 2021): the scene is fixed, the
code of a photograph is fitted to its left half, and the right half is evaluated. The
renderer is linear in the colors of the Gaussians, so one pass renders an image and its
Jacobian, and Gauss-Newton converges in a few of them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gaussians_jax.core import splats
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.scene import drawing, scene
from gaussians_jax.scene.spec import raster_of
from gaussians_jax.splatting import harmonics, rendering
from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.representation import HalfScorer
from nerfies_jax.geometry.precision import exact_product
from nerfies_jax.training.model import TrainState, View, in_default_precision

# Rendered images with Jacobians in a fit, at most, and the relative decrease of the
# error at which it ends, or the damping from which none is expected.
PASSES, ENOUGH, STUCK = 30, 1e-4, 1e4
RIDGE = 1e-6  # price of the squared code per pixel, in squared color
DAMPING, LOWER, RAISE = 1e-3, 0.1, 10.0  # of the steps, relative to the diagonal


class _Normal(NamedTuple):
    """Image and squared error of a code, and its normal equations."""

    code: Float[Array, " code"]
    image: Float[Array, "*pixels 3"]
    cost: Float[Array, ""]
    matrix: Float[Array, "code code"]
    gradient: Float[Array, " code"]


def fit_code(
    evaluate: Callable[
        [Float[Array, " code"]],
        tuple[Float[Array, "*pixels 3"], Float[Array, "*pixels 3 code"]],
    ],
    truth: Float[Array, "*pixels 3"],
    valid: Bool[Array, "*pixels"],
    start: Float[Array, " code"],
) -> tuple[Float[Array, " code"], Float[Array, "*pixels 3"]]:
    """Fit a code to an image by damped Gauss-Newton steps (Levenberg-Marquardt).

    Args:
      evaluate: Function of a code that returns an image and its Jacobian.
      truth: The observed image.
      valid: True for the pixels to fit.
      start: Initial code, which is returned if nothing is better.

    Returns:
      The code with the smallest sum of squared errors and of the price of the code,
      and its image.
    """
    weight = valid[..., None].astype(truth.dtype)
    price = RIDGE * jnp.maximum(jnp.sum(weight), 1)
    length = start.shape[0]

    def normal(code):
        image, jacobian = evaluate(code)
        # Unobserved pixels may be NaN.
        error = jnp.where(weight > 0, truth - image, 0).reshape(-1)
        rows = (weight[..., None] * jacobian).reshape(-1, length)
        return _Normal(
            code,
            image,
            jnp.sum(error**2) + price * jnp.sum(code**2),
            exact_product(rows.T, rows) + price * jnp.eye(length, dtype=code.dtype),
            exact_product(rows.T, error) - price * code,
        )

    def step(loop_state):
        best, damping, passes, _ = loop_state
        diagonal = damping * jnp.diag(jnp.diag(best.matrix))
        change = jnp.linalg.solve(best.matrix + diagonal, best.gradient)
        trial = normal(best.code + change)
        better = trial.cost < best.cost
        little = best.cost - trial.cost < ENOUGH * best.cost
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), trial, best)
        damping = damping * jnp.where(better, LOWER, RAISE)
        # Without a first image there is nothing to improve.
        is_done = (better & little) | (damping > STUCK) | ~jnp.isfinite(best.cost)
        return best, damping, passes + 1, is_done

    def should_continue(loop_state):
        _, _, passes, is_done = loop_state
        return (passes < PASSES) & ~is_done

    # One evaluation in the program: the first step, from an infinite cost, is to
    # `start` itself.
    unknown = _Normal(
        start,
        jnp.zeros_like(truth),
        jnp.asarray(jnp.inf, start.dtype),
        jnp.eye(length, dtype=start.dtype),
        jnp.zeros_like(start),
    )
    damping = jnp.asarray(DAMPING / LOWER, start.dtype)
    begin = unknown, damping, jnp.int32(0), jnp.asarray(False)
    best, *_ = jax.lax.while_loop(should_continue, step, begin)
    return best.code, best.image


def scorer(spec, metadata, size: tuple[int, int]) -> HalfScorer:
    """Return a function that evaluates right halves with codes of left halves.

    Args:
      spec: The scene, with an appearance model.
      metadata: Scene metadata.
      size: Width and height of the images in pixels.

    Returns:
      A function of a trained state, a capture and the indices of its frames, which
      returns the metrics.
    """
    effects = scene.all_effects(spec, metadata)
    stages = scene.build(spec, metadata).stages
    appearance = drawing.appearance_of(effects)
    assert stages is not None
    assert appearance is not None
    raster = raster_of(spec, metadata)

    def at(params, view, step):
        """Return a function from a code to an image and its Jacobian."""
        cache = stages.prepare(params)
        gaussians = stages.deform(params, cache, view.time)
        degree = splats.active_degree(step, spec.sh_every, spec.sh_degree)
        rows = splats.active_harmonics(stages.rows(params), degree)
        camera = view.camera
        colors = harmonics.color_toward(rows, gaussians.mean, camera.position)
        direction = drawing.directions(camera, size, distorted=raster.distorted)

        def image_and_jacobian(code):
            paint = _painter(appearance, params, colors, direction, metadata)
            new_colors, behind = paint(code)
            of_gaussians, of_sky = jax.jacfwd(paint)(code)
            features = of_gaussians.reshape(len(new_colors), -1)
            frame = rendering.render(
                gaussians,
                new_colors,
                camera,
                size,
                raster,
                behind,
                features,
                depth=False,
            )
            transmittance = 1 - frame.rendering.alpha
            jacobian = frame.features.reshape(*transmittance.shape, 3, -1)
            jacobian = jacobian + transmittance[..., None, None] * of_sky
            return frame.rendering.color, jacobian

        return image_and_jacobian

    @jax.jit
    def solve(params, view, truth, valid, step):
        start = jnp.zeros_like(appearance.code(params, view.appearance))
        return fit_code(at(params, view, step), truth, valid, start)[1]

    def score(
        state: TrainState, capture: Capture, rows: np.ndarray
    ) -> evaluation.Halves:
        def fit_image(view: View, left: np.ndarray, valid: np.ndarray | None):
            # The renderer's images are whole, so the right half is not to be fitted.
            right = ((0, 0), (0, size[0] - left.shape[1]))
            is_observed = np.ones(left.shape[:2], bool) if valid is None else valid
            truth = np.pad(left.astype(np.float32) / 255, (*right, (0, 0)))
            inputs = in_default_precision((truth, np.pad(is_observed, right)))
            return solve(state.params, view, *inputs, state.step)

        # The fitted image is rendered already.
        return evaluation.score_halves(fit_image, lambda _, x: x, capture, rows)

    return score


def _painter(appearance: SplatRecord, params, colors, direction, metadata):
    """Return a function from a code to the colors of Gaussians and background."""
    recolor, backdrop = appearance.recolor, appearance.backdrop
    assert recolor is not None

    def paint(code):
        if backdrop is None:
            behind = jnp.asarray(metadata.background, colors.dtype)
            behind = jnp.broadcast_to(behind, direction.shape)
        else:
            behind = backdrop(params, direction, code)
        return recolor(params, colors, code), behind

    return paint
