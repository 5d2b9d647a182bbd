"""Distortion of rendered pinhole images, to compare them with captured images."""

import numpy as np

from nerfies_jax.capture import pinholes, resampling
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.training.model import Rendering, TrainState, View


class ThroughLens:
    """Renderer of distorted images, on top of a renderer of pinhole images.

    The render of the undistorted camera is sampled where each distorted pixel looks:
    color and opacity with a Lanczos filter, and depth, which must not be mixed across
    edges, at the nearest pixel. Everything is 0 outside of the pinhole image. Those
    pixels are not `valid` in `pinholes.scorable`. Views without distortion are passed
    through.
    """

    def __init__(self, draw: Draw, size: tuple[int, int]):
        self._draw = draw
        self._maps = pinholes.Maps(pinholes.pinhole_places, size)

    def __call__(self, state: TrainState, view: View) -> Rendering:
        """Render one image of the size (width, height) given by `size`, in NumPy."""
        if not pinholes.has_lens(view.camera):
            return self._draw(state, view)
        straight = view._replace(camera=pinholes.pinhole(view.camera))
        drawn = self._draw(state, straight)
        place, inside = self._maps.of(view.camera)
        flat = np.concatenate([drawn.color, np.asarray(drawn.alpha)[..., None]], -1)
        flat = np.asarray(flat, np.float32)
        flat = np.where(inside[..., None], resampling.lanczos(flat, place), 0)
        # The filter has negative lobes.
        flat = np.clip(flat, 0, 1)
        depth = np.asarray(drawn.depth)
        bent = np.where(inside, resampling.nearest(depth, place), 0).astype(depth.dtype)
        return Rendering._make((flat[..., :3], flat[..., 3], bent))
