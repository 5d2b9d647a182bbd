"""Initialize Gaussians and their motion from tracks.

Static Gaussians start from the dense points of preprocessing. The motion is fitted to
the paths of moving tracks. Then moving pixels of all frames are unprojected with the
depths of nearby tracks, and moved back by that motion to their canonical positions.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Params
from gaussians_jax.init import path_fit
from gaussians_jax.init.path_fit import Depth, Paths, Points, PyTree, Resting
from gaussians_jax.init.points import StartSpec
from nerfies_jax.capture.capture import Capture
from nerfies_jax.preprocessing import record, usable_paths, view_set
from nerfies_jax.preprocessing.moving import picture_scale
from nerfies_jax.preprocessing.record import Evidence

DEPTH_TRACKS, DEPTH_REACH_PX = 6, 8.0  # whose depth a moving pixel takes
CARRIERS = 3  # points of the fit that carry a seed, and lend a Gaussian its rows
FAR = 0.045  # of the unit: a seed farther from every point of the fit is dropped
GONE = 0.75  # of the unit: a seed carried back farther than that is dropped
ROUNDS = 8  # of carrying back


class TrackStart(NamedTuple):
    """Initial Gaussians and motion of a scene, on the host."""

    position: np.ndarray  # [moving, 3] canonical, scene units
    color: np.ndarray  # [moving, 3] in [0, 1]
    rows: Any  # per-Gaussian parameters of the motion; None without any
    nets: Any  # of the motion
    time: np.ndarray  # [moving] time of the frame that each was unprojected from
    followed: np.ndarray  # [moving] duration of nearby tracks, in units of the video
    resting: Resting | None = None  # what the networks were fitted to hold still


def start(
    spec: StartSpec,
    effect: SplatRecord,
    evidence: Evidence,
    capture: Capture,
    key: jax.Array,
) -> TrackStart:
    """The motion fitted to the evidence's paths, and Gaussians that it carries.

    ValueError where `usable_paths.unusable` says why.
    """
    reason = usable_paths.unusable(evidence)
    if reason:
        raise ValueError(
            f"{capture.path or capture.name}: no start from tracks: {reason}"
        )
    position, known, deviation = usable_paths.known_paths(evidence)
    times = capture.times[evidence.row].astype(np.float32)
    unit = usable_paths.scene_unit(evidence)
    still = np.asarray(evidence.still.position, np.float32)
    views = view_set.in_time_order(record.looked_at(capture, evidence.factor))
    ray = position - views.position
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    depth = Depth(ray, deviation)
    fitted = path_fit.fit(
        effect,
        Paths(times, position.astype(np.float32), known, unit, still, depth),
        key,
        rate=spec.fit_rate,
        steps=spec.fit_steps,
    )
    followed = known.mean(axis=1).astype(np.float32)
    return _seeds(effect, fitted.points, followed, evidence, views, times, unit, spec)


def _seeds(effect, points, followed, evidence, views, times, unit, spec):
    """Unproject moving pixels of all frames, and move them to canonical positions."""
    rng = np.random.default_rng(0)
    depth = moving_depths(evidence)
    frame, row, column = np.nonzero(depth > 0)
    # Twice as many as wanted: some are dropped.
    chosen = rng.permutation(len(frame))[: 2 * spec.moving_points]
    frame, row, column = frame[chosen], row[chosen], column[chosen]
    canonical = np.asarray(points.canonical)
    own = None if points.rows is None else jax.tree.map(np.asarray, points.rows)
    places = jax.jit(lambda points, time: path_fit.places(effect, points, time))
    # Nothing of each: in no frame need there be tracks enough.
    none = np.zeros((0, 3), np.float32)
    positions, colors, spans = [none], [none], [np.zeros((2, 0))]
    rows = [] if own is None else [jax.tree.map(lambda leaf: leaf[:0], own)]
    # All frames share the programs: as many rows as the frame with most.
    most = int(np.bincount(frame).max()) if len(frame) else 0
    for here in np.unique(frame):
        at = np.flatnonzero(frame == here)
        pixel = np.stack([column[at], row[at]], -1)
        ray = view_set.rays(views, int(here))[row[at], column[at]]
        seen = views.position[here] + ray * depth[here][row[at], column[at], None]
        now = np.asarray(places(points, times[here]))
        distance, near, share = _carriers(now, seen)

        def mixed(leaf, near=near, share=share):
            return _mixed(leaf, near, share)

        mine = None if own is None else jax.tree.map(mixed, own)
        start = seen + np.einsum("nk,nkc->nc", share, canonical[near] - now[near])

        def padded(leaf):
            return np.pad(leaf, [(0, most - len(leaf))] + [(0, 0)] * (leaf.ndim - 1))

        padded_rows = None if mine is None else jax.tree.map(padded, mine)
        back = start.astype(np.float32)
        for _ in range(ROUNDS):
            there = Points(padded(back), padded_rows, points.nets)
            back = back - (np.asarray(places(there, times[here]))[: len(at)] - seen)
            back = back.astype(np.float32)
        miss = np.linalg.norm(back - start, axis=1)
        kept = (distance[:, 0] < FAR * unit) & (miss < GONE * unit)
        positions.append(back[kept])
        here_for = np.full(int(kept.sum()), times[here])
        spans.append(np.stack([here_for, mixed(followed)[kept]]))
        colors.append(views.image[here][pixel[kept, 1], pixel[kept, 0]] / 255)
        if mine is not None:
            rows.append(jax.tree.map(lambda leaf, kept=kept: leaf[kept], mine))
    position, color = np.concatenate(positions), np.concatenate(colors)
    chosen = np.sort(rng.permutation(len(position))[: spec.moving_points])
    every = None
    if rows:
        every = jax.tree.map(lambda *leaves: np.concatenate(leaves)[chosen], *rows)
    span = np.concatenate(spans, axis=1)[:, chosen]
    return TrackStart(
        position[chosen], color[chosen], every, points.nets, *span, points.resting
    )


def _carriers(places, wanted):
    """Distances, indices and shares [wanted, carriers] of the places near each."""
    distance, near = cKDTree(places).query(wanted, min(CARRIERS, len(places)))
    near, distance = near.reshape(len(wanted), -1), distance.reshape(len(wanted), -1)
    share = np.exp(-distance / (distance.mean(1, keepdims=True) + 1e-12))
    return distance, near, share / share.sum(1, keepdims=True)


def _mixed(leaf, near, share):
    return np.einsum("nk,nk...->n...", share, leaf[near]).astype(leaf.dtype)


def moving_depths(evidence: Evidence) -> np.ndarray:
    """Interpolate the z-depth of moving pixels from nearby tracks.

    Args:
      evidence: Results of preprocessing.

    Returns:
      [frames, height, width] z-depth in scene units, 0 where unknown.
    """
    depths = np.zeros(evidence.moving.shape, np.float32)
    tracks = evidence.tracks.take(evidence.moved)
    for frame, mask in enumerate(evidence.moving):
        here = np.flatnonzero(evidence.paths.known[:, frame])
        row, column = np.nonzero(mask)
        if len(here) < DEPTH_TRACKS or not len(row):
            continue
        tree = cKDTree(tracks.pixel[here, frame])
        distance, near = tree.query(np.stack([column, row], -1) + 0.5, DEPTH_TRACKS)
        depth = np.median(evidence.paths.depth[here, frame][near], axis=1)
        depth[distance[:, 0] > DEPTH_REACH_PX * picture_scale(mask.shape[1])] = 0
        depths[frame, row, column] = depth
    return depths


def rows_at_rest(resting: Resting, places: Float[Array, "places 3"]) -> PyTree:
    """Return the motion parameters of static points near each position, on the host.

    With newly sampled parameters, static Gaussians moved at once. On the built-in
    scene, where moving points travel 0.023 scene units, they moved by 0.002 with a KAN
    and by 0.010 with the two networks of E-D3DGS. With these parameters it is 0.0004
    and 0.00002.

    Args:
      resting: Static points of the fit, and their parameters.
      places: Positions in scene units.

    Returns:
      Per-Gaussian parameters of the motion.
    """
    still, own = jax.tree.map(np.asarray, resting)
    _, near, share = _carriers(still, np.asarray(places))
    return jax.tree.map(lambda leaf: jnp.asarray(_mixed(leaf, near, share)), own)


def put_in(
    params: Params, effects: tuple[SplatRecord, ...], tracked: TrackStart
) -> Params:
    """Insert the fitted motion, which is the first effect, into the parameters.

    The tracked Gaussians are the last ones, and all others are static.

    Args:
      params: Initial parameters.
      effects: Effects of the scene.
      tracked: Initial Gaussians and motion.

    Returns:
      Parameters with the motion.
    """
    rows, nets = dict(params.rows), dict(params.nets)

    def last(leaf, own):
        return leaf.at[len(leaf) - len(own) :].set(jnp.asarray(own, leaf.dtype))

    motion, *others = effects
    if tracked.nets is not None:
        nets[motion.name] = jax.tree.map(jnp.asarray, tracked.nets)
    if tracked.resting is not None and tracked.resting.rows is not None:
        rows[motion.name] = rows_at_rest(tracked.resting, rows["splats"].mean)
    if tracked.rows is not None:
        rows[motion.name] = jax.tree.map(last, rows[motion.name], tracked.rows)
    for effect in others:
        if effect.lifted_rows is not None:
            own = effect.lifted_rows(tracked.time, tracked.followed)
            rows[effect.name] = jax.tree.map(last, rows[effect.name], own)
    return Params(rows, nets)
