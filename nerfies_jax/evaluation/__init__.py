"""Frames of a capture, the renderer, and metrics of rendered images."""

from nerfies_jax.evaluation.frames import (
    check_frames,
    frames_of,
    path_views,
    resized,
    spread,
    training_frames,
    view_of,
    with_refined_cameras,
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
    "check_frames",
    "frames_of",
    "known_mean",
    "path_views",
    "resized",
    "score",
    "score_halves",
    "score_right_halves",
    "spread",
    "to_uint8",
    "training_frames",
    "view_of",
    "with_refined_cameras",
]
