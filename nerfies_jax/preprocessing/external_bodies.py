"""Depth of moving bodies from external depth: one scale for each body.

A network that predicts depth from one image orders the surfaces of an image well, but
the distance of a body from its surroundings is a guess. Each body therefore has one
factor on its depth, for the whole video. Three cues determine it: the external depth
itself, the paths that the video determines without it, and occlusion, since a body is
in front of the static surfaces that it hides.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from nerfies_jax.preprocessing import rigid_groups
from nerfies_jax.preprocessing.paths import Paths
from nerfies_jax.preprocessing.static_points import StaticPoints
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.view_set import Views, in_image, project

GROUPS = 12
FEWEST = 6  # positions that determine a factor
# Deviation of the factor of a body in units of that of external depth at static points,
# and its least value, for depth that is measured.
BODY_DEVIATION, LEAST_DEVIATION = 2.0, 0.01
# Least relative deviation of paths from the video alone. Where they follow the depth of
# their surroundings, their estimate can be much smaller than their error.
VIDEO_DEVIATION = 0.03
NEAR_PX = 2.0  # from a moving track to a static point that it hides
HIDDEN_SHARE = 0.25  # of the points that may be in front nevertheless, by error
MOST_POINTS = 2000  # static points that are tested for being hidden


class BodyDepth(NamedTuple):
    """External depth at moving tracks, scaled for each body."""

    depth: np.ndarray  # [tracks, frames] z-depth in scene units, NaN if unknown
    body: np.ndarray  # [tracks] index of the body
    factor: np.ndarray  # [tracks] factor that was applied to the external depth
    deviation: np.ndarray  # [tracks] relative standard deviation of the factor


def scaled(
    views: Views,
    tracks: Tracks,
    measured: np.ndarray,
    alone: Paths,
    static: Tracks,
    static_fit: StaticPoints,
    deviation: float,
) -> BodyDepth:
    """Find the factor of each body between external depth and its depth in the scene.

    Args:
      views: The frames.
      tracks: Moving tracks.
      measured: External z-depths of the tracks, aligned to static points, [tracks,
        frames], NaN if unknown.
      alone: Paths of the tracks without the external depth.
      static: Static tracks.
      static_fit: Their points.
      deviation: Relative deviation of the external depth at static points.

    Returns:
      The scaled depth.
    """
    body = _bodies(tracks, measured, alone)
    bound = _bounds(views, tracks, measured, static, static_fit)
    prior = max(BODY_DEVIATION * deviation, LEAST_DEVIATION)
    count = len(measured)
    factor, spread = np.ones(count), np.full(count, prior)
    for group in np.unique(body):
        rows = np.flatnonzero(body == group)
        is_common = tracks.visible[rows] & (measured[rows] > 0) & alone.known[rows]
        log, weight = 0.0, 1 / prior**2
        if is_common.sum() >= FEWEST:
            ratio = np.log(alone.depth[rows][is_common] / measured[rows][is_common])
            video = np.hypot(np.median(alone.depth_deviation[rows]), VIDEO_DEVIATION)
            # Errors of paths beyond a common factor make their median less certain.
            scatter = np.median(np.abs(ratio - np.median(ratio)))
            precision = 1 / (video**2 + scatter**2)
            log = precision * np.median(ratio) / (precision + weight)
            weight += precision
        limits = bound[rows][np.isfinite(bound[rows])]
        if len(limits) >= FEWEST:
            log = min(log, np.log(np.quantile(limits, HIDDEN_SHARE)))
        factor[rows], spread[rows] = np.exp(log), weight**-0.5
    return BodyDepth(measured * factor[:, None], body, factor, spread)


def _bodies(tracks, depth, alone):
    """Group tracks by rigid motion. Tracks whose paths are unknown form one body."""
    body = np.full(len(depth), -1)
    rows = np.flatnonzero(alone.known.sum(1) >= FEWEST)
    if len(rows) >= 2 * FEWEST:
        position, is_known = alone.position[rows], alone.known[rows]
        body[rows] = rigid_groups.labels(position, is_known, GROUPS)
    return body


def _bounds(views, tracks, external_depth, static, static_fit):
    """Largest factors with which tracks are in front of the static points they hide.

    Static points that project to a moving track, but are not visible there, are hidden.

    Returns:
      Ratios of depths [tracks, frames], NaN where no static point is hidden.
    """
    bound = np.full(external_depth.shape, np.nan)
    stride = -(-len(static_fit.position) // MOST_POINTS) or 1
    points, visible = static_fit.position[::stride], static.visible[::stride]
    for frame in range(external_depth.shape[1]):
        here = np.flatnonzero(tracks.visible[:, frame] & (external_depth[:, frame] > 0))
        pixel, depth = project(views, frame, points)
        is_hidden = in_image(views, pixel, depth) & ~visible[:, frame]
        if not len(here) or not is_hidden.any():
            continue
        gap, near = cKDTree(pixel[is_hidden]).query(tracks.pixel[here, frame])
        close = gap < NEAR_PX
        ratio = depth[is_hidden][near[close]] / external_depth[here[close], frame]
        bound[here[close], frame] = ratio
    return bound
