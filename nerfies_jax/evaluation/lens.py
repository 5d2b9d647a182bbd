"""Lens distortion of rendered pinhole images, to compare them with captured images."""

import numpy as np

from nerfies_jax.capture import pinholes, resampling
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.training.model import Rendering, TrainState, View


class ThroughLens:
    """Renderer of distorted images, on top of a renderer of pinhole images.

    The render of the undistorted camera is sampled at the viewing ray of each distorted
    pixel: color and opacity with a Lanczos filter, and depth, which must not be mixed
    across edges, at the nearest pixel. Pixels outside of the pinhole image are 0. They
    are not `valid` in `pinholes.scorable`. Views without distortion are passed through.

    Args:
      draw: Renderer of pinhole images.
      size: Width and height in pixels.
    """

    def __init__(self, draw: Draw, size: tuple[int, int]):
        self._draw = draw
        self._maps = pinholes.Maps(pinholes.pinhole_places, size)

    def __call__(self, state: TrainState, view: View) -> Rendering:
        """Render one image, in NumPy."""
        if not pinholes.has_lens(view.camera):
            return self._draw(state, view)
        pinhole = view._replace(camera=pinholes.pinhole(view.camera))
        rendering = self._draw(state, pinhole)
        position, inside = self._maps.of(view.camera)
        alpha = np.asarray(rendering.alpha)[..., None]
        rgba = np.concatenate([rendering.color, alpha], -1).astype(np.float32)
        rgba = np.where(inside[..., None], resampling.lanczos(rgba, position), 0)
        # The filter has negative lobes.
        rgba = np.clip(rgba, 0, 1)
        depth = np.asarray(rendering.depth)
        distorted = np.where(inside, resampling.nearest(depth, position), 0)
        distorted = distorted.astype(depth.dtype)
        return Rendering._make((rgba[..., :3], rgba[..., 3], distorted))
