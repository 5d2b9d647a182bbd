"""Renders of pinholes as a lens would have filmed them, to hold them against film."""

import numpy as np

from nerfies_jax.capture import pinholes, resampling
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.training.model import Rendering, TrainState, View


class ThroughLens:
    """What a renderer of pinholes draws, on the pixel grid of the filmed picture.

    The render of the camera without its lens is read where each filmed pixel looks:
    color and alpha bilinearly, depth, which must not be mixed over an edge, from the
    nearest pixel. Everything is 0 where the pinhole does not look; those pixels are
    not `valid` in `pinholes.scorable`. A view without a lens is passed on.
    """

    def __init__(self, draw: Draw, size: tuple[int, int]):
        self._draw = draw
        self._maps = pinholes.Maps(pinholes.pinhole_places, size)

    def __call__(self, state: TrainState, view: View) -> Rendering:
        """One picture, of (width, height) `size`; NumPy."""
        if not pinholes.has_lens(view.camera):
            return self._draw(state, view)
        straight = view._replace(camera=pinholes.pinhole(view.camera))
        drawn = self._draw(state, straight)
        place, inside = self._maps.of(view.camera)
        flat = np.concatenate([drawn.color, np.asarray(drawn.alpha)[..., None]], -1)
        flat = np.where(inside[..., None], resampling.bilinear(flat, place), 0)
        depth = np.asarray(drawn.depth)
        return Rendering(
            flat[..., :3],
            flat[..., 3],
            np.where(inside, resampling.nearest(depth, place), 0).astype(depth.dtype),
        )
