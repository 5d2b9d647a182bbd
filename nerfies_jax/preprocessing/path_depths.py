"""Depth of moving points: from depth maps, or from the video alone."""

import numpy as np
import scipy.ndimage as nd

from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.external import ExternalResults
from nerfies_jax.preprocessing import (
    dense_points,
    external_bodies,
    external_depth,
    external_resampling,
    paths,
    rigid_bodies,
)
from nerfies_jax.preprocessing import tracks as tracking
from nerfies_jax.preprocessing.external_depth import AlignedDepth
from nerfies_jax.preprocessing.paths import Paths
from nerfies_jax.preprocessing.static_points import StaticPoints
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.view_set import Views
from nerfies_jax.preprocessing.watch import A_BODY_TERM, A_PATH_FRAME, Watch

FOR_BODIES = 0.7  # share of the budget above which rigid bodies are not refined
# Minimum depth of moving points as a share of the near plane, which is computed from
# static points. Moving objects, such as a hand, may be much closer.
AT_CAMERA = 0.1
# Relative deviation of the depth of static points that external depth is aligned to,
# and the share of frames that must have enough of them.
SURE_DEPTH, MOST_FRAMES_SURE = 0.1, 0.8


def known(
    capture: Capture,
    external: ExternalResults,
    views: Views,
    static: tuple[Tracks, StaticPoints],
    use_depths: bool,
) -> AlignedDepth | None:
    """Return the depth maps that constrain paths, in scene units.

    Args:
      capture: The capture.
      external: External results.
      views: The frames.
      static: Static tracks and their points.
      use_depths: True to use the depth maps of the capture, if there are no external
        ones.

    Returns:
      The depth maps, None if there are none.

    Raises:
      CaptureError: If external depth maps do not fit the static points.
    """
    depth = external_resampling.depth(external, views)
    if depth is None:
        if not use_depths or capture.depths is None:
            return None
        exact = np.zeros(len(views.row))
        return AlignedDepth(capture.depths[views.row], exact, 0.0)
    tracks, static_fit = _well_placed(views, *static)
    aligned_depth = external_depth.aligned(depth, tracks, static_fit, external.inverse)
    miss, name = aligned_depth.total_miss, capture.path or capture.name
    if not np.isfinite(miss):
        kinds = {
            None: "neither as depth nor as inverse depth",
            True: "as inverse depth",
        }
        raise CaptureError(
            f"{name}: the external depth maps fit the static points in no frame, "
            f"{kinds.get(external.inverse, 'as depth')}; remove them, or check that "
            "enough of the scene is static and has texture"
        )
    if miss > external_depth.USABLE:
        raise CaptureError(
            f"{name}: the external depth maps differ from the static points by "
            f"{miss:.0%} (median), more than {external_depth.USABLE:.0%}; check that "
            "they belong to these frames, or remove them"
        )
    return aligned_depth


def _well_placed(views, tracks, static_fit):
    """Return the static points whose depth is certain, or all if they are few."""
    sure = dense_points.depth_deviation(views, tracks, static_fit) < SURE_DEPTH
    if (tracks.visible[sure].sum(0) >= external_depth.FEWEST).mean() < MOST_FRAMES_SURE:
        return tracks, static_fit
    return tracks.take(sure), static_fit.take(sure)


def fitted(
    capture: Capture,
    views: Views,
    moving: Tracks,
    static: tuple[Tracks, StaticPoints],
    depths: AlignedDepth | None,
    watch: Watch,
    least_known: int = rigid_bodies.LEAST_KNOWN,
) -> Paths:
    """Fit 3D paths to moving tracks.

    Args:
      capture: The capture.
      views: The frames.
      moving: Moving tracks.
      static: Static tracks and their points.
      depths: Depth maps, or None.
      watch: Work budget.
      least_known: Minimum number of frames of a path. Shorter ones than
        `rigid_bodies.LEAST_KNOWN` are used on rigid objects only.

    Returns:
      The paths.
    """
    watch.spend(1e-6 * A_PATH_FRAME * moving.visible.size)
    around = paths.depth_around(moving, *static, capture.near)
    least = AT_CAMERA * capture.near
    alone = paths.least_acceleration(views, moving, least, around)

    def has_room(terms):
        what = "depths of rigid bodies"
        return watch.has_room(FOR_BODIES, what, 1e-6 * A_BODY_TERM * terms)

    if depths is None and least_known < rigid_bodies.LEAST_KNOWN:
        return rigid_bodies.refined_short(views, moving, alone, least_known, has_room)
    if depths is None:
        return rigid_bodies.refined(views, moving, alone, has_room)
    track_depth = _measure_depth(depths.depth, moving)
    deviation = depths.deviation(paths.MEASURED_DEVIATION)
    if capture.external is None or capture.external.depth is None:
        return paths.least_acceleration(
            views, moving, least, around, track_depth, deviation
        )
    watch.spend(1e-6 * A_PATH_FRAME * moving.visible.size)
    miss = external_depth.PER_MEDIAN * depths.total_miss
    near, static_fit = _well_placed(views, *static)
    bodies = external_bodies.scaled(
        views, moving, track_depth, alone, near, static_fit, miss
    )
    smooth = paths.least_acceleration(
        views, moving, least, around, bodies.depth, deviation
    )
    refined_paths = rigid_bodies.refined(views, moving, smooth, has_room)
    return refined_paths._replace(depth_deviation=bodies.deviation)


def _measure_depth(depths, tracks):
    """Return z-depths of tracks, NaN if unknown or at a depth discontinuity."""
    track_depth = np.full(tracks.visible.shape, np.nan)
    for frame, depth_map in enumerate(depths):
        rows = np.flatnonzero(tracks.visible[:, frame])
        depth = _steady_depth(depth_map)
        at = tracking.pixel_of(tracks.pixel[rows, frame], depth.shape)
        track_depth[rows, frame] = depth[at]
    return track_depth


def _steady_depth(depth: np.ndarray, jump: float = 0.06) -> np.ndarray:
    """Select known z-depths that are not at a depth discontinuity."""
    least, most = nd.minimum_filter(depth, 3), nd.maximum_filter(depth, 3)
    return np.where((least > 0) & (most - least < jump * depth), depth, np.nan)
