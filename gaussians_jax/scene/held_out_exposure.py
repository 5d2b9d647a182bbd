"""Exposures of held-out frames, fitted to one half of each frame.

This is the protocol of NeRF-W (Martin-Brualla et al. 2021). The scene is fixed, and
metrics are computed on the other half, as for the codes of radiance fields.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from gaussians_jax.per_frame import exposure
from gaussians_jax.scene import scene
from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.training.model import Rendering, TrainState, View


def score(
    spec,
    metadata,
    state: TrainState,
    capture: Capture,
    rows: np.ndarray,
) -> evaluation.Halves | None:
    """Compute metrics of right halves of frames, with exposures of the left halves.

    Returns:
      The metrics, or None if the scene has no exposure model.
    """
    if spec.exposure is None:
        return None
    neutral = dataclasses.replace(spec, exposure=None)
    model = scene.build(neutral, metadata)
    renderer = evaluation.Renderer(model, capture.size)

    def fit_code(view: View, left: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
        color = np.asarray(renderer(state, view).color)
        rendering = color[:, : left.shape[1]]
        return exposure.fit(rendering, left.astype(np.float32) / 255, valid)

    def render(view: View, change: np.ndarray) -> Rendering:
        rendering = renderer(state, view)
        image = jnp.asarray(rendering.color)
        color = exposure.apply_exposure(image, jnp.asarray(change, image.dtype))
        return rendering._replace(color=jax.device_get(color))

    return evaluation.score_halves(fit_code, render, capture, rows)
