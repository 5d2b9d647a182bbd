"""Frames of a capture, the renderer, and metrics of rendered images."""

from nerfies_jax.evaluation.frames import (
    as_found,
    frames_of,
    path_views,
    resized,
    spread,
    view_of,
)
from nerfies_jax.evaluation.renderer import Renderer, to_uint8
from nerfies_jax.evaluation.scores import (
    Halves,
    Scored,
    known_mean,
    score,
    score_halves,
    score_right_halves,
)

__all__ = [
    "Halves",
    "Renderer",
    "Scored",
    "as_found",
    "frames_of",
    "known_mean",
    "path_views",
    "resized",
    "score",
    "score_halves",
    "score_right_halves",
    "spread",
    "to_uint8",
    "view_of",
]
