"""Initialize Gaussians and their motion from tracks.

Static Gaussians are initialized from the dense points of preprocessing. The motion is
fitted to the paths of moving tracks. Then moving pixels of all frames are unprojected
with the depths of nearby tracks, as fitted, and mapped by the inverse motion to their
canonical positions. With the depths of the paths themselves, which the motion does not
follow exactly, surfaces from different frames would lie behind each other, and the
nearest ones would hide the others.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gaussians_jax.core import splats
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.init import motion_fit
from gaussians_jax.init.motion_fit import Depth, Paths, Points, PyTree, Resting
from gaussians_jax.init.points import StartSpec
from nerfies_jax.capture.capture import Capture
from nerfies_jax.preprocessing import record, usable_paths, view_set
from nerfies_jax.preprocessing.moving import image_scale
from nerfies_jax.preprocessing.record import Evidence
from nerfies_jax.preprocessing.usable_paths import KnownPaths
from nerfies_jax.training import programs

DEPTH_TRACKS, DEPTH_REACH_PX = 12, 8.0  # tracks that give a moving pixel its depth
FEWEST_TRACKS = 6  # in a frame
# Robust fits of a plane to them, with the least typical relative error, and a ridge
# relative to their extent, because they may lie in a line.
ROBUST_ROUNDS, DEPTH_NOISE, RIDGE = 4, 3e-3, 0.02
SURFACE = 16  # nearest Gaussians that give the orientation of the surface
CARRIERS = 3  # points of the fit that determine a Gaussian's motion parameters
FAR = 0.045  # of the unit: Gaussians farther from every point of the fit are dropped
GONE = 0.75  # of the unit: Gaussians with a larger displacement are dropped
ROUNDS = 8  # iterations of the inverse motion


class TrackStart(NamedTuple):
    """Initial Gaussians and motion of a scene, on the host."""

    position: np.ndarray  # [moving, 3] canonical, scene units
    color: np.ndarray  # [moving, 3] in [0, 1]
    rows: Any  # per-Gaussian parameters of the motion, or None
    nets: Any  # shared parameters of the motion
    time: np.ndarray  # [moving] time of the frame that each was unprojected from
    followed: np.ndarray  # [moving] duration of nearby tracks, in units of the video
    resting: Resting | None = None  # static points of the fit


def start(
    spec: StartSpec,
    effect: SplatRecord,
    evidence: Evidence,
    capture: Capture,
    key: jax.Array,
) -> TrackStart:
    """Fit the motion to the paths of tracks, and initialize moving Gaussians.

    Args:
      spec: Settings.
      effect: The motion.
      evidence: Results of preprocessing.
      capture: The capture.
      key: PRNG key.

    Returns:
      The initial Gaussians and motion.

    Raises:
      ValueError: If the tracks are not usable (`usable_paths.unusable`).
    """
    reason = usable_paths.unusable(evidence)
    if reason:
        raise ValueError(
            f"{capture.path or capture.name}: no initialization from tracks: {reason}"
        )
    paths = usable_paths.known_paths(evidence)
    times = capture.times[evidence.row].astype(np.float32)
    unit = usable_paths.scene_unit(evidence)
    static_points = np.asarray(evidence.static_cloud.position, np.float32)
    views = view_set.in_time_order(record.downscale(capture, evidence.factor))
    ray = paths.position - views.position
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    # Paths on a rigid object already have its shape, so they count fully along rays.
    depth = Depth(ray, np.where(paths.is_rigid, np.inf, paths.depth_deviation))
    position = paths.position.astype(np.float32)
    fit_result = motion_fit.fit(
        effect,
        Paths(times, position, paths.known, unit, static_points, depth),
        key,
        rate=spec.fit_rate,
        steps=spec.fit_steps,
    )
    return _seeds(effect, fit_result.points, paths, evidence, views, times, unit, spec)


def _seeds(effect, points, paths, evidence, views, times, unit, spec):
    """Unproject moving pixels of all frames to canonical positions."""
    rng = np.random.default_rng(0)
    canonical, padded_fit = np.asarray(points.canonical), motion_fit.padded(points)
    visibility = paths.known.mean(axis=1).astype(np.float32)
    positions_at = programs.Program(motion_fit.positions_at, effect)
    fitted_paths = np.stack(
        [np.asarray(positions_at(padded_fit, time))[: len(canonical)] for time in times]
    )
    depth = moving_depths(
        evidence, paths, views.depth_of(np.moveaxis(fitted_paths, 0, 1))
    )
    frame, row, column = np.nonzero(depth > 0)
    # Twice as many as needed, because some are dropped.
    selection = rng.permutation(len(frame))[: 2 * spec.moving_points]
    frame, row, column = frame[selection], row[selection], column[selection]
    point_rows = None if points.rows is None else jax.tree.map(np.asarray, points.rows)
    # Empty arrays, because there may be no frame with enough tracks.
    empty = np.zeros((0, 3), np.float32)
    positions, colors, spans = [empty], [empty], [np.zeros((2, 0))]
    rows = (
        [] if point_rows is None else [jax.tree.map(lambda leaf: leaf[:0], point_rows)]
    )
    # Padded, so that all frames share one program, and most captures as well.
    most = int(np.bincount(frame).max()) if len(frame) else 0
    most = splats.capacity_for(most)
    for current in np.unique(frame):
        pixels = np.flatnonzero(frame == current)
        pixel = np.stack([column[pixels], row[pixels]], -1)
        ray = view_set.rays(views, int(current))[row[pixels], column[pixels]]
        pixel_position = (
            views.position[current]
            + ray * depth[current][row[pixels], column[pixels], None]
        )
        position_then = fitted_paths[current]
        distance, neighbors, weights = _carriers(position_then, pixel_position)

        def mix(leaf, neighbors=neighbors, weights=weights):
            return _mix(leaf, neighbors, weights)

        pixel_rows = None if point_rows is None else jax.tree.map(mix, point_rows)
        start = pixel_position + np.einsum(
            "nk,nkc->nc", weights, canonical[neighbors] - position_then[neighbors]
        )

        def pad(leaf):
            return np.pad(leaf, [(0, most - len(leaf))] + [(0, 0)] * (leaf.ndim - 1))

        padded_rows = None if pixel_rows is None else jax.tree.map(pad, pixel_rows)
        canonical_position = start.astype(np.float32)
        for _ in range(ROUNDS):
            padded_points = Points(pad(canonical_position), padded_rows, points.nets)
            canonical_position = canonical_position - (
                np.asarray(positions_at(padded_points, times[current]))[: len(pixels)]
                - pixel_position
            )
            canonical_position = canonical_position.astype(np.float32)
        displacement = np.linalg.norm(canonical_position - start, axis=1)
        is_valid = (distance[:, 0] < FAR * unit) & (displacement < GONE * unit)
        positions.append(canonical_position[is_valid])
        times_of = np.full(int(is_valid.sum()), times[current])
        spans.append(np.stack([times_of, mix(visibility)[is_valid]]))
        colors.append(
            views.image[current][pixel[is_valid, 1], pixel[is_valid, 0]] / 255
        )
        if pixel_rows is not None:
            rows.append(
                jax.tree.map(lambda leaf, valid=is_valid: leaf[valid], pixel_rows)
            )
    position, color = np.concatenate(positions), np.concatenate(colors)
    selection = np.sort(rng.permutation(len(position))[: spec.moving_points])
    all_rows = None
    if rows:
        all_rows = jax.tree.map(
            lambda *leaves: np.concatenate(leaves)[selection], *rows
        )
    span = np.concatenate(spans, axis=1)[:, selection]
    return TrackStart(
        position[selection],
        color[selection],
        all_rows,
        points.nets,
        *span,
        points.resting,
    )


def _carriers(positions, queries):
    """Return distances, indices and weights [queries, carriers] of nearby points."""
    distance, neighbors = cKDTree(positions).query(
        queries, min(CARRIERS, len(positions))
    )
    neighbors, distance = (
        neighbors.reshape(len(queries), -1),
        distance.reshape(len(queries), -1),
    )
    weights = np.exp(-distance / (distance.mean(1, keepdims=True) + 1e-12))
    return distance, neighbors, weights / weights.sum(1, keepdims=True)


def _mix(leaf, neighbors, weights):
    return np.einsum("nk,nk...->n...", weights, leaf[neighbors]).astype(leaf.dtype)


def moving_depths(
    evidence: Evidence, paths: KnownPaths, depth: np.ndarray
) -> np.ndarray:
    """Interpolate the z-depth of moving pixels from nearby tracks.

    Args:
      evidence: Results of preprocessing.
      paths: Paths of moving points.
      depth: Their z-depths in scene units, [paths, frames].

    Returns:
      [frames, height, width] z-depth in scene units, 0 where unknown.
    """
    depths = np.zeros(evidence.moving.shape, np.float32)
    for frame, mask in enumerate(evidence.moving):
        # A fit may place a point behind the camera.
        rows = np.flatnonzero(paths.known[:, frame] & (depth[:, frame] > 0))
        row, column = np.nonzero(mask)
        if len(rows) < FEWEST_TRACKS or not len(row):
            continue
        pixel = np.stack([column, row], -1) + 0.5
        track_pixel = paths.tracks.pixel[rows, frame]
        count = min(DEPTH_TRACKS, len(rows))
        distance, neighbors = cKDTree(track_pixel).query(pixel, count)
        offset = track_pixel[neighbors] - pixel[:, None]
        plane = _on_planes(offset, depth[rows, frame][neighbors])
        plane[distance[:, 0] > DEPTH_REACH_PX * image_scale(mask.shape[1])] = 0
        depths[frame, row, column] = plane
    return depths


def _on_planes(offset, depth):
    """Return the depth at pixels, [pixels], of planes through the points around them.

    The inverse depth of a plane is linear in the image. A mean depth would be too near
    at the silhouettes of objects, which are farther than the points inside: by 0.4 % of
    the distance of a cube in the median of its pixels, and 1 % in a quarter of them.

    Args:
      offset: Offsets of the points in pixels, [pixels, points, 2].
      depth: Their z-depths, [pixels, points].
    """
    inverse = 1 / depth
    typical = np.median(inverse, axis=1)[:, None]
    value, ones = inverse / typical, np.ones((*inverse.shape, 1))
    design, weight = np.concatenate([ones, offset], -1), np.ones(inverse.shape)
    for _ in range(ROBUST_ROUNDS):
        gram = np.einsum("pk,pki,pkj->pij", weight, design, design)
        ridge = RIDGE * 0.5 * (gram[:, 1, 1] + gram[:, 2, 2])[:, None, None]
        gram += ridge * np.diag([0.0, 1, 1]) + 1e-9 * np.eye(3)
        target = np.einsum("pk,pki,pk->pi", weight, design, value)
        plane = np.linalg.solve(gram, target[..., None])[..., 0]
        miss = np.abs(np.einsum("pki,pi->pk", design, plane) - value)
        scale = DEPTH_NOISE + np.median(miss, axis=1, keepdims=True)
        weight = 1 / (1 + (miss / scale) ** 2)
    # At most half the range of the points beyond them, and twice as far.
    low, high = value.min(1), value.max(1)
    margin = (high - low) / 2
    least = np.maximum(low - margin, low / 2)
    return 1 / (np.clip(plane[:, 0], least, high + margin) * typical[:, 0])


def rows_at_rest(resting: Resting, positions: Float[Array, "places 3"]) -> PyTree:
    """Return the motion parameters of static points near each position, on the host.

    Newly initialized parameters would move static Gaussians at once: in the built-in
    scene, where moving points travel 0.023 scene units, by 0.002 with a KAN and by
    0.010 with the two networks of E-D3DGS. With these parameters they move by 0.0004
    and 0.00002.

    Args:
      resting: Static points of the fit, and their parameters.
      positions: Positions in scene units.

    Returns:
      Per-Gaussian parameters of the motion.
    """
    static, static_rows = jax.tree.map(np.asarray, resting)
    _, neighbors, weights = _carriers(static, np.asarray(positions))
    return jax.tree.map(lambda leaf: _mix(leaf, neighbors, weights), static_rows)


def flattened(rows: Splats, position: np.ndarray, thickness: float) -> Splats:
    """Align the last Gaussians with their surface, and make them thin, on the host.

    The normal of the surface is the direction in which the nearest of these Gaussians
    extend least.

    Args:
      rows: Raw parameters, isotropic.
      position: Means of the last of them, [moving, 3].
      thickness: Scale along the normal, relative to the others.

    Returns:
      Raw parameters.
    """
    count = min(SURFACE, len(position))
    if count < 4 or thickness == 1:  # with fewer there is no surface
        return rows
    _, near = cKDTree(position).query(position, count)
    offset = position[near] - position[near].mean(1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))
    axes[..., 0] *= np.linalg.det(axes)[:, None]
    quaternion, log_scale = np.array(rows.quaternion), np.array(rows.log_scale)
    wxyz = Rotation.from_matrix(axes).as_quat(scalar_first=True)
    quaternion[len(quaternion) - len(position) :] = wxyz
    log_scale[len(log_scale) - len(position) :, 0] += np.log(thickness)
    return rows._replace(
        quaternion=jax.device_put(quaternion), log_scale=jax.device_put(log_scale)
    )


def put_in(
    params: Params, effects: tuple[SplatRecord, ...], tracked: TrackStart
) -> Params:
    """Insert the fitted motion, which is the first component, into the parameters.

    The tracked Gaussians are the last ones, and all others are static.

    Args:
      params: Initial parameters.
      effects: Components of the scene.
      tracked: Initial Gaussians and motion.

    Returns:
      Parameters with the motion.
    """
    rows, nets = dict(params.rows), dict(params.nets)

    def set_last(leaf, values):
        if not len(values):  # no moving pixel has a depth
            return leaf
        new_leaf = np.array(leaf)
        new_leaf[len(leaf) - len(values) :] = np.asarray(values)
        return new_leaf

    motion, *others = effects
    if tracked.nets is not None:
        nets[motion.name] = tracked.nets
    if tracked.resting is not None and tracked.resting.rows is not None:
        rows[motion.name] = rows_at_rest(tracked.resting, rows["splats"].mean)
    if tracked.rows is not None:
        rows[motion.name] = jax.tree.map(set_last, rows[motion.name], tracked.rows)
    for effect in others:
        if effect.lifted_rows is not None:
            values = effect.lifted_rows(tracked.time, tracked.followed)
            rows[effect.name] = jax.tree.map(set_last, rows[effect.name], values)
    return Params(rows, nets)
