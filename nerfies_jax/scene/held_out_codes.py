"""Appearance codes of held-out frames, fitted to one half of each.

This is the protocol of NeRF-W (Martin-Brualla et al. 2021): the network is frozen, the
code is fitted to the left half of a frame, and the right half is evaluated.
"""

from typing import Any

import jax
import numpy as np

from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.representation import HalfScorer
from nerfies_jax.fields import field_ray, skipping
from nerfies_jax.scene import scene
from nerfies_jax.training import fit, losses, programs
from nerfies_jax.training.effects import APPEARANCE, FrameCondition
from nerfies_jax.training.model import TrainState, View, in_default_precision

RAYS = 512  # of the left half, to which a code is fitted
# L-BFGS has nearly converged after some twenty steps of about two evaluations each.
MOST_STEPS = 20
EVALUATIONS = 2 * MOST_STEPS
# Gradient of the mean squared error per unit of code. 1e-4 ends 30 dB below 1e-6, with
# the same number of steps.
TOLERANCE = 1e-6


def scorer(spec, metadata, size: tuple[int, int]) -> HalfScorer | None:
    """Return a function that evaluates right halves with codes of left halves.

    A transient medium is left out, because transient objects are in one frame only.

    Args:
      spec: The scene.
      metadata: Scene metadata.
      size: Width and height of the frames in pixels.

    Returns:
      A function of a trained state, a capture and the indices of its frames, which
      returns the metrics. None if the field has no codes that only training frames
      have.
    """
    whole = scene.field(spec, metadata)
    names = {effect.name for effect in whole.effects}
    passing = tuple(sorted({"transient"} & names))
    field = scene.field(spec, metadata, passing)
    tables = _tables(field)
    if not tables:
        return None
    has_guide = spec.sampling.occupancy is not None

    def render_codes(field, params, camera, time, codes, step):
        return field.render(params, camera, time, codes, size, step)

    def look_up(field, params, view):
        return field.codes_at(params, view)

    def fit_codes(field, params, view, pixels, colors, step):
        # With the same samples as the rendered image.
        guide = field.survey(params, step)[skipping.GUIDE] if has_guide else None
        codes = field.codes_at(params, view)

        def loss(candidate):
            condition = FrameCondition(view.time, codes | candidate, step)

            def color_of(pixel):
                ray, _ = field_ray.field_ray_through(field.metadata, view.camera, pixel)
                return field.render_ray(params, ray, condition, guide=guide)[-1].color

            return losses.mse(jax.vmap(color_of)(pixels), colors)

        start = {name: codes[name] for name in tables}
        solution = fit.fit_code(loss, start, max_steps=MOST_STEPS, tolerance=TOLERANCE)
        return codes | solution.value

    draw, codes_of, solve = (
        programs.Program(each, field) for each in (render_codes, look_up, fit_codes)
    )

    def score(
        state: TrainState, capture: Capture, rows: np.ndarray
    ) -> evaluation.Halves:
        params, step = state.params, state.step

        def fit_code(view: View, left: np.ndarray, valid: np.ndarray | None) -> Any:
            mask = np.ones(left.shape[:2], bool) if valid is None else valid
            place = np.argwhere(mask)
            if not len(place):  # no valid pixels
                return codes_of(params, view)
            # With replacement, so that shapes do not depend on the number of pixels.
            sample = np.random.default_rng(0).integers(len(place), size=RAYS)
            line, column = place[sample].T
            pixels = in_default_precision(np.stack([column, line], axis=1) + 0.5)
            colors = in_default_precision(left[line, column].astype(np.float32) / 255)
            return solve(params, view, pixels, colors, step)

        def render(view: View, codes: Any) -> np.ndarray:
            return np.asarray(draw(params, view.camera, view.time, codes, step).color)

        return evaluation.score_halves(fit_code, render, capture, rows)

    return score


def _tables(field):
    tables = [table for effect in field.effects for table in effect.tables]
    return sorted({table.name for table in tables if table.by == APPEARANCE})
