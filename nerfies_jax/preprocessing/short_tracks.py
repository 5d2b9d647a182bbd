"""Tracks of few frames, for cameras that move far from one frame to the next.

Points of a rotating object are then visible in few frames, which nevertheless have
enough parallax.
"""

from typing import NamedTuple

import numpy as np

from nerfies_jax.preprocessing import rigid_bodies
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.view_set import Views

# Median angle between two positions of the camera, seen from the scene, above which
# tracks may be short. It is 0.17 for `rig`, and 0.06 or less for other built-in scenes.
WIDE_RAD = 0.1
# Minimum share of textured pixels with consistent flow to the next frame. Without flow,
# short tracks are chance: photographs of a static scene in no order (`static-20`) have
# 0.56, and would show motion. `rig` has 0.79.
LEAST_CARRIED = 0.7


class Lengths(NamedTuple):
    """Minimum numbers of frames."""

    track: int
    path: int  # of a moving track with a path
    known: int  # in which a usable path is known


USUAL = Lengths(tracking.SHORTEST, 10, rigid_bodies.LEAST_KNOWN)
SHORT = Lengths(3, 3, 3)


def lengths(views: Views, span: tuple[float, float], carried: float) -> Lengths:
    """Return the minimum lengths of tracks and paths.

    Args:
      views: The frames.
      span: Nearest and farthest z-depth in scene units.
      carried: Share of the textured pixels with consistent flow to the next frame.

    Returns:
      `SHORT` if the cameras move far between frames with consistent flow, otherwise
      `USUAL`.
    """
    if len(views.row) < 2 or carried < LEAST_CARRIED:
        return USUAL
    step = np.median(np.linalg.norm(np.diff(views.position, axis=0), axis=-1))
    distance = 2 / (1 / span[0] + 1 / span[1])
    return SHORT if step > WIDE_RAD * distance else USUAL
