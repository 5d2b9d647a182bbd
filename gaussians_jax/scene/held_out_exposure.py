"""Exposures of frames that were never learned from, fitted to half of each.

The protocol of NeRF-W (Martin-Brualla et al. 2021), as for the codes of fields: the
scene stays as it is, and the other half is scored.
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
    """Scores of the right halves of frames, their exposure fitted to the left ones.

    None where the scene has no exposures.
    """
    if spec.exposure is None:
        return None
    neutral = dataclasses.replace(spec, exposure=None)
    model = scene.build(neutral, metadata)
    renderer = evaluation.Renderer(model, capture.size)

    def fit_code(view: View, left: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
        color = np.asarray(renderer(state, view).color)
        drawn = color[:, : left.shape[1]]
        return exposure.fitted(drawn, left.astype(np.float32) / 255, valid)

    def render(view: View, change: np.ndarray) -> Rendering:
        drawn = renderer(state, view)
        picture = jnp.asarray(drawn.color)
        color = exposure.changed(picture, jnp.asarray(change, picture.dtype))
        return drawn._replace(color=jax.device_get(color))

    return evaluation.score_halves(fit_code, render, capture, rows)
