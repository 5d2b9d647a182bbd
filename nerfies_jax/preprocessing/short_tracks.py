"""Tracks of few frames, for cameras that move far from one frame to the next.

Points of a rotating object are then visible in few frames, which nevertheless have
enough parallax.
"""

from typing import NamedTuple

import numpy as np

from nerfies_jax.preprocessing import moving, rest_points, rigid_bodies
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.rest_points import RestPoints
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.view_set import Views
from nerfies_jax.preprocessing.watch import A_TRACK_FRAME, Watch

# Median angle between two positions of the camera, seen from the scene, above which
# tracks may be short. It is 0.17 for `rig`, and 0.06 or less for other built-in scenes.
WIDE_RAD = 0.1
# Minimum share of textured pixels with consistent flow to the next frame. Without flow,
# short tracks are chance: photographs of a static scene in no order (`static-20`) have
# 0.56, and would show motion. `rig` has 0.79.
LEAST_CARRIED = 0.7
FOR_MORE = 0.6  # share of the budget above which no more tracks are added


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


def with_more(
    views: Views,
    flow: NeighborFlow,
    images: np.ndarray,
    mask: np.ndarray,
    tracks: tuple[Tracks, RestPoints, np.ndarray],
    watch: Watch,
) -> tuple[Tracks, RestPoints, np.ndarray]:
    """Add tracks that begin on moving pixels in every frame.

    Args:
      views: The frames.
      flow: Their flow.
      images: Enlarged images from `dense_flow.leveled`.
      mask: Moving pixels, [frames, height, width] bool.
      tracks: Tracks, their static points, and their scores.
      watch: Work budget.

    Returns:
      All tracks, their static points, and their scores.
    """
    starts = tracking.grid_on(mask)
    work = 1e-6 * A_TRACK_FRAME * len(starts) * len(views.row)
    if not watch.has_room(FOR_MORE, "more tracks of moving objects", work):
        return tracks
    more = tracking.from_flow(views, flow, images, starts, SHORT.track)
    points = rest_points.fit(views, more)
    score = moving.settled(more, moving.track_scores(more, points), mask)
    return (
        Tracks(*map(np.concatenate, zip(tracks[0], more, strict=True))),
        RestPoints(*map(np.concatenate, zip(tracks[1], points, strict=True))),
        np.concatenate([tracks[2], score]),
    )
