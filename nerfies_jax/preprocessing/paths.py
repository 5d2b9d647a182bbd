"""3D paths of moving points, from their tracks in the images.

A path minimizes acceleration along the rays of a track: trajectory triangulation (Park
et al. 2010, "3D reconstruction of a moving point from a series of 2D projections") with
a penalty in place of a basis. Depth is determined if the motion of the camera differs
from that of the objects. Otherwise the cost is constant along the rays, and the paths
follow the depth of the surroundings.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.spatial import cKDTree

from nerfies_jax.geometry.rays import across_ray
from nerfies_jax.preprocessing.static_points import StaticPoints, track_rays
from nerfies_jax.preprocessing.tracks import TRACK_PX, Tracks
from nerfies_jax.preprocessing.view_set import Views

# Range of the weight of squared acceleration (in units per squared frame) relative to
# squared distances to rays. Videos with many frames and slow motion need large weights:
# in built-in scenes of 60 frames errors are the same from 1 to 30 (0.6 %). With five
# times as many frames they are 4 % at 10, and 0.6 % at 1000 and more.
LEAST_PENALTY, MOST_PENALTY = 10.0, 1e5
TRIED = 300  # tracks for choosing the penalty of a video
# Relative deviation of the depth of the surroundings. With `TRACK_PX` its weight is
# 1e-5 of that of a ray at a focal length of 200 px. This suffices for passing vehicles,
# and does not change the errors in built-in scenes.
AROUND_DEVIATION = 0.5
MEASURED_DEVIATION = 0.03  # of depths stored with the capture
AROUND = 8  # static tracks that determine the depth of the surroundings
STATIC_SCORE = 0.3  # tracks with a lower score are static
NO_DEPTH = 1e-9  # scene units, because unconstrained paths end in the camera
SHORTEST_STEP = 0.1  # of the median time between frames, for frames at the same time


class Paths(NamedTuple):
    """Positions of moving points over time."""

    # [tracks, frames, 3] scene units, NaN before and after a track
    position: np.ndarray
    known: np.ndarray  # [tracks, frames] bool: visible and in front of the camera
    depth: np.ndarray  # [tracks, frames] z-depth, NaN before and after a track
    # [tracks] relative deviation of a common factor of the depths, from the video
    # alone. Above about 0.3 the depths are those of the surroundings.
    depth_deviation: np.ndarray
    # [tracks] bool, on a rigid object: the shape of the path is precise, but the factor
    # of its depths is not.
    is_rigid: np.ndarray


def least_acceleration(
    views: Views,
    tracks: Tracks,
    near: float,
    around: np.ndarray | None = None,
    measured: np.ndarray | None = None,
    measured_deviation: np.ndarray | float = MEASURED_DEVIATION,
) -> Paths:
    """Fit paths along the rays of tracks, with one banded linear system each.

    The paths are as smooth as the tracks allow: the penalty is the largest power of ten
    with which half of the paths are within the error of a track (Morozov's discrepancy
    principle), because the real time between frames is unknown.

    Args:
      views: The frames.
      tracks: The tracks.
      near: Least z-depth in scene units. Closer positions are not known.
      around: z-depths of the surroundings, [tracks, frames], NaN if unknown, or None.
      measured: z-depths of the points from depth maps, [tracks, frames], NaN if
        unknown, or None.
      measured_deviation: Relative standard deviations of `measured`, a number or
        [frames].

    Returns:
      The paths.
    """
    ray = track_rays(views, tracks)
    noise = TRACK_PX / np.median(views.intrinsics[:, 0, 0])
    pull, target = np.zeros(tracks.visible.shape), np.zeros(tracks.visible.shape)
    for depth, deviation in (
        (around, AROUND_DEVIATION),
        (measured, measured_deviation),
    ):
        if depth is not None:
            usable = tracks.visible & np.isfinite(depth)
            pull = np.where(usable, (noise / deviation) ** 2, pull)
            target = np.where(usable, depth, target)
    problem = _Problem(ray, tracks.visible, pull, target)
    some = slice(None, None, -(-len(ray) // TRIED) or 1)
    penalty = _penalty(views, _Problem(*(part[some] for part in problem)), noise)
    position, flatness = _fit(views, problem, penalty, noise)
    return certain(views, tracks, position, near)._replace(depth_deviation=flatness)


def certain(views: Views, tracks: Tracks, position: np.ndarray, near: float) -> Paths:
    """Create paths from tracks with known positions.

    Args:
      views: The frames.
      tracks: The tracks.
      position: Positions in scene units, [tracks, frames, 3].
      near: Least z-depth in scene units.

    Returns:
      The paths.
    """
    depth = views.depth_of(position)
    usable = tracks.visible & (np.nan_to_num(depth, nan=-1.0) > near)
    count = len(position)
    return Paths(position, usable, depth, np.zeros(count), np.zeros(count, bool))


class _Problem(NamedTuple):
    """Rays and depths that paths should pass through."""

    ray: np.ndarray  # [tracks, frames, 3] with z-depth one
    visible: np.ndarray  # [tracks, frames] bool
    pull: np.ndarray  # [tracks, frames] weight of the depth relative to the ray
    depth: np.ndarray  # [tracks, frames] target z-depth


def _penalty(views, problem, noise):
    """Return the largest penalty with which half of the paths fit within the noise."""
    penalty = LEAST_PENALTY
    while 10 * penalty <= MOST_PENALTY and len(problem.ray):
        position, _ = _fit(views, problem, 10 * penalty, noise)
        sine = np.cross(position - views.position, problem.ray)
        for side in (position - views.position, problem.ray):
            sine /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), NO_DEPTH)
        error_sq = np.where(problem.visible, (sine**2).sum(-1), 0).sum(1)
        if np.median(np.sqrt(error_sq / problem.visible.sum(1))) > noise:
            break
        penalty *= 10
    return penalty


def _fit(views, problem, penalty, noise):
    """Return positions, and deviations of their depths."""
    length = np.linalg.norm(problem.ray, axis=-1)
    unit = problem.ray / length[..., None]
    position = np.full((*problem.visible.shape, 3), np.nan)
    flatness = np.full(len(problem.visible), np.inf)
    for row, visible in enumerate(problem.visible):
        first, last = np.flatnonzero(visible)[[0, -1]]
        span = slice(first, last + 1)
        stencils = np.sqrt(penalty) * second_differences(views.time[span])
        along = unit[row, span]
        weight, pull = visible[span].astype(float), problem.pull[row, span]
        across = across_ray(along)
        onto = np.eye(3) - across
        blocks = weight[:, None, None] * across + pull[:, None, None] * onto
        camera = views.position[span]
        place = camera + problem.ray[row, span] * problem.depth[row, span, None]
        right = weight[:, None] * np.einsum("fij,fj->fi", across, camera)
        right += pull[:, None] * np.einsum("fij,fj->fi", onto, place)
        path = _solve(blocks, _bands(stencils, len(along)), right)
        position[row, span] = path
        # Offsets from the cameras replace rays, which invisible frames do not have.
        offset = path - camera
        far = np.median(np.linalg.norm(offset, axis=-1)[visible[span]])
        flatness[row] = _deviation(stencils, path, offset, noise * far)
    return position, flatness


def _deviation(stencils, path, offset, miss):
    """Estimate the standard deviation of a common factor of the depths.

    A factor adds the curvature of the offsets from the camera to the path. It is
    indistinguishable from the curvature of the path itself and from the error `miss` of
    a track in scene units. Errors of neighboring frames are not independent, so the
    mean over the path is used instead of the sum. In the built-in scenes the estimate
    is 2 to 4 %, and the true errors are 0.6 to 1.1 %.
    """
    if not len(stencils):
        return np.inf

    def squared_bend(place):
        count = len(stencils)
        parts = (stencils[:, k, None] * place[k : k + count] for k in range(3))
        return (sum(parts) ** 2).sum(-1).mean()

    noise_power = squared_bend(path) + miss**2 / len(stencils)
    signal_power = squared_bend(offset)
    return np.sqrt(noise_power / signal_power) if signal_power > 0 else np.inf


def second_differences(time: np.ndarray) -> np.ndarray:
    """Return the weights of three consecutive frames for their acceleration.

    Args:
      time: Times in increasing order, [frames].

    Returns:
      Weights, [frames - 2, 3], for accelerations per squared median step.
    """
    if len(time) < 3:
        return np.zeros((0, 3))
    steps = np.diff(time)
    median = np.median(steps)
    steps = np.maximum(steps / median if median > 0 else steps + 1.0, SHORTEST_STEP)
    middle = 0.5 * (steps[:-1] + steps[1:])
    before, after = 1 / (steps[:-1] * middle), 1 / (steps[1:] * middle)
    return np.stack([before, -before - after, after], axis=-1)


def _bands(stencils, frames):
    """Return diagonals 0, 1 and 2 of the penalty, padded on the right, [3, frames]."""
    count = len(stencils)
    bands = np.zeros((3, frames))
    for off in range(3):
        for at in range(3 - off):
            bands[off, at : at + count] += stencils[:, at] * stencils[:, at + off]
    return bands


def _solve(blocks, bands, right):
    """Solve the system of 3 x 3 blocks plus the penalty on each coordinate."""
    frames = len(blocks)
    lower = np.zeros((7, 3 * frames))
    for off in range(3):
        lower[3 * off] = np.repeat(bands[off], 3)
        for column in range(3 - off):
            lower[off, column::3] += blocks[:, column + off, column]
    # For tracks without any parallax, whose depth is undetermined. It pulls them to the
    # origin, at the largest penalty by 0.2 % against the depth of the surroundings.
    lower[0] += 1e-14 * max(lower[0].max(), 1e-30)
    return scipy.linalg.solveh_banded(lower, right.ravel(), lower=True).reshape(-1, 3)


def depth_around(
    tracks: Tracks, static: Tracks, static_fit: StaticPoints, near: float
) -> np.ndarray:
    """Compute the median z-depth of the nearest static tracks.

    Args:
      tracks: Moving tracks.
      static: Static tracks.
      static_fit: Points of the static tracks.
      near: Least z-depth in scene units.

    Returns:
      z-depths in scene units [tracks, frames], NaN without static tracks.
    """
    depth = np.full(tracks.visible.shape, np.nan)
    for frame in range(tracks.visible.shape[1]):
        here = np.flatnonzero(
            static.visible[:, frame] & (static_fit.depth[:, frame] > near)
        )
        rows = np.flatnonzero(tracks.visible[:, frame])
        if len(here) < AROUND or not len(rows):
            continue
        tree = cKDTree(static.pixel[here, frame])
        _, nearest = tree.query(tracks.pixel[rows, frame], AROUND)
        depth[rows, frame] = np.median(static_fit.depth[here, frame][nearest], axis=1)
    return depth
