"""Exposures of held-out frames, fitted to one half of each frame.

This is the protocol of NeRF-W (Martin-Brualla et al. 2021). The scene is fixed, and
metrics are computed on the other half, as for the codes of radiance fields.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from gaussians_jax.per_frame import exposure
from gaussians_jax.scene import held_out_appearance, scene
from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.representation import HalfScorer
from nerfies_jax.training.model import Rendering, TrainState, View


def scorer(spec, metadata, size: tuple[int, int]) -> HalfScorer | None:
    """Return a function that evaluates right halves with exposures of left halves.

    Args:
      spec: The scene.
      metadata: Scene metadata.
      size: Width and height of the frames in pixels.

    Returns:
      A function of a trained state, a capture and the indices of its frames, which
      returns the metrics. None if the scene models no light of single images.
    """
    if spec.appearance is not None:
        return held_out_appearance.scorer(spec, metadata, size)
    if spec.exposure is None:
        return None
    neutral = dataclasses.replace(spec, exposure=None)
    model = scene.build(neutral, metadata)
    renderer = evaluation.Renderer(model, size)

    def score(
        state: TrainState, capture: Capture, rows: np.ndarray
    ) -> evaluation.Halves:
        def fit_code(view: View, left: np.ndarray, valid: np.ndarray | None):
            rendering = renderer(state, view)
            color = np.asarray(rendering.color)[:, : left.shape[1]]
            change = exposure.fit(color, left.astype(np.float32) / 255, valid)
            return rendering, change

        def render(_, fit: tuple[Rendering, np.ndarray]) -> np.ndarray:
            rendering, change = fit
            image = jnp.asarray(rendering.color)
            color = exposure.apply_exposure(image, jnp.asarray(change, image.dtype))
            return jax.device_get(color)

        return evaluation.score_halves(fit_code, render, capture, rows)

    return score
