"""Initialization of the motion of a field from point tracks, before training.

A warp maps observed points back to the template. Tracked points determine it: positions
of one point at all times map to one point of the template, and static points to
themselves. A scene flow leads from the position of a point to its next and previous
positions, and is zero at static points. Gradient descent on images does not find this
for motion of more than a few pixels.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from nerfies_jax.fields.effects import scene_flow, timestamps
from nerfies_jax.fields.field import Field
from nerfies_jax.preprocessing import usable_paths
from nerfies_jax.preprocessing.record import Evidence
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.model import View
from nerfies_jax.training.track_start import TrackStartSpec
from nerfies_jax.training.updates import minimize

PyTree = Any
FRAMES_AT_ONCE, POINTS_AT_ONCE, STILL_AT_ONCE = 12, 256, 128  # per step
SOFT = 1e-3  # field units; the loss is quadratic in distances below it
SOFT_FLOW = 0.05  # the same for flow, relative to the mean known flow
# Weight of the squared logarithmic stretch of moving objects by the warp, relative to
# distances in field units. Without it moving objects shrink in the template, which
# reduces distances: ||log Σ|| of the Jacobian is 2.75 there, and the error of tracked
# points of the built-in scene is 0.0176 units. With it they are 0.15 and 0.0094 (0.0240
# for a static scene).
STRETCH = 0.3
LEAST_STRETCH = 1e-6  # squared; bounds the logarithm of collapsed directions


class PointPaths(NamedTuple):
    """Tracked points of a video, in units of the field."""

    time: Float[np.ndarray, " frames"]
    appearance: np.ndarray  # [frames] appearance ids
    position: Float[np.ndarray, "points frames 3"]  # arbitrary if unknown
    known: Bool[np.ndarray, "points frames"]
    static: Float[np.ndarray, "static 3"]  # static points


def point_paths(field: Field, capture, evidence: Evidence) -> PointPaths:
    """Convert paths and static points of preprocessing to units of the field.

    Args:
      field: The field.
      capture: The capture.
      evidence: Its preprocessing.

    Returns:
      The paths.
    """
    metadata = field.metadata

    def inside(place):
        return ((place - np.asarray(metadata.center)) * metadata.scale).astype(
            np.float32
        )

    position, valid, *_ = usable_paths.known_paths(evidence)
    return PointPaths(
        capture.times[evidence.row].astype(np.float32),
        capture.appearance_ids[evidence.row],
        inside(np.where(valid[..., None], position, 0)),
        valid,
        inside(evidence.static_cloud.position),
    )


def fit(
    field: Field,
    params: PyTree,
    paths: PointPaths,
    key: Key[Array, ""],
    start: TrackStartSpec,
) -> PyTree:
    """Fit the warp by gradient descent on the spread of each point in the template.

    The optimized variables are the warps, the codes that they read, and the positions
    in the template, which start where the points are in the middle of their own time.
    Static points are kept in place, and moving objects keep their size.

    Args:
      field: The field.
      params: Its initial parameters.
      paths: Paths of points.
      key: PRNG key.
      start: Settings.

    Returns:
      The parameters of the whole field, with those that were fitted.

    Raises:
      ValueError: If no position is known.
    """
    if not paths.known.any():
        raise ValueError("no path is known anywhere: nothing to fit a warp to")
    distances = _distances(field, params, paths)

    def loss(free, key):
        key, direction_key = jax.random.split(key)
        sample = _sample(paths, len(paths.time), key)
        return sum(distances(*free, *sample, direction_key))

    names = {effect.name for effect in field.effects if effect.displace is not None}
    names &= params.keys()  # effects from other packages may have no parameters
    free = (
        {name: params[name] for name in (*sorted(names), "codes")},
        jnp.asarray(_first_places(paths)),
    )
    solution = minimize(loss, free, start.fit_rate, key, start.fit_steps)
    return params | solution[0]


def fit_flow(
    field: Field,
    params: PyTree,
    paths: PointPaths,
    key: Key[Array, ""],
    start: TrackStartSpec,
) -> PyTree:
    """Fit the scene flow to the displacements of points between frames.

    Displacements between frames that are not one interval apart are scaled. The
    optimized variables are the network of the medium and everything that its flow
    reads.

    Args:
      field: The field.
      params: Its initial parameters.
      paths: Paths of points.
      key: PRNG key.
      start: Settings.

    Returns:
      The parameters of the whole field, with those that were fitted.

    Raises:
      ValueError: If no point is known in two consecutive frames.
    """
    apart = np.diff(paths.time)
    valid = paths.known[:, 1:] & paths.known[:, :-1] & (apart > 0)
    if not valid.any():
        raise ValueError(
            "no path is known in two frames that follow each other: nothing to fit a "
            "scene flow to"
        )
    intervals = np.where(apart > 0, apart, 1)
    intervals = intervals / timestamps.interval(len(field.metadata.times))
    shift = np.diff(paths.position, axis=1) / intervals[:, None]
    unit = max(float(np.linalg.norm(shift, axis=-1)[valid].mean()), 1e-12)
    unit = jax.device_put(np.asarray(unit, shift.dtype))  # captured, not a constant
    errors = _flow_distances(field, paths, shift, valid)

    def loss(medium, key):
        sample = _sample(paths, len(intervals), key)
        return sum(errors(medium, *sample, SOFT_FLOW * unit)) / unit

    medium = params[scene_flow.NAME]
    solution = minimize(loss, medium, start.fit_rate, key, start.fit_steps)
    return params | {scene_flow.NAME: solution}


def _flow_distances(field, paths, shift, valid):
    """Return a function of (medium, frames, rows, static points, soft).

    It computes the mean error of the flow of the rows, to the next timestamp and back,
    and the mean flow of static points, in field units. `soft` is the distance below
    which the error is quadratic.
    """
    spec, time = field.spec.scene_flow, jnp.asarray(paths.time)
    position = jnp.asarray(np.moveaxis(paths.position, 1, 0))
    target = jnp.asarray(np.moveaxis(np.where(valid[..., None], shift, 0), 1, 0))
    weight = jnp.asarray(valid.T, position.dtype)

    def errors(medium, frames, rows, static, soft):
        @functools.partial(jax.vmap, in_axes=(0, None))
        def flow(point, time):
            return scene_flow.dynamic(
                spec, medium, point, jnp.zeros_like(point), time
            ).flow

        def frame_errors(frame):
            following = frame + 1
            ahead = flow(position[frame][rows], time[frame])[:, scene_flow.FORWARD]
            back = flow(position[following][rows], time[following])[
                :, scene_flow.BACKWARD
            ]
            goal = target[frame][rows]
            moving = (_length(ahead - goal, soft) + _length(back + goal, soft)) / 2
            return moving, _length(flow(static, time[frame]), soft)

        return _means(*jax.vmap(frame_errors)(frames), weight[frames][:, rows])

    return errors


def _distances(field, params, paths):
    """Return a function of (params, template positions, frames, rows, static, key).

    It computes the mean distances of the warped points of the rows from their positions
    in the template, and of static points from themselves, in field units, and the cost
    of stretching at the points of the rows, estimated in one random direction each.
    """
    position = jnp.asarray(np.moveaxis(paths.position, 1, 0))
    weight = jnp.asarray(paths.known.T, position.dtype)
    time, appearance = jnp.asarray(paths.time), jnp.asarray(paths.appearance)
    last_step = jnp.asarray(field.spec.steps)  # all bands of the warp are open

    def distances(trainable, canonical, frames, rows, static, key):
        def frame_distances(frame, key):
            view = View(None, time[frame], appearance[frame])
            codes = field.codes_at(params | trainable, view)
            condition = FrameCondition(view.time, codes, last_step)

            def warp(point):
                return point + field.displace(params | trainable, point, condition)

            def along(point, direction):
                return jax.jvp(warp, (point,), (direction,))

            points = position[frame][rows]
            place, tangents = jax.vmap(along)(points, _directions(key, points))
            # Computed from the square, since a norm has no gradient at zero.
            stretch = jnp.log(jnp.sum(tangents**2, axis=-1) + LEAST_STRETCH) / 2
            gap, static_gap = place - canonical[rows], jax.vmap(warp)(static) - static
            return _length(gap), _length(static_gap), stretch**2

        moving, resting, stretch = jax.vmap(frame_distances)(
            frames, jax.random.split(key, len(frames))
        )
        sample_weight = weight[frames][:, rows]
        moving, resting = _means(moving, resting, sample_weight)
        return moving, resting, STRETCH * _mean(stretch, sample_weight)

    return distances


def _directions(key, like):
    """Sample a uniformly distributed unit vector for each point."""
    normal = jax.random.normal(key, like.shape, like.dtype)
    return normal / jnp.linalg.norm(normal, axis=-1, keepdims=True)


def _length(gap, soft=SOFT):
    return jnp.sqrt(jnp.sum(gap**2, axis=-1) + soft**2)


def _sample(paths, frames, key):
    """Sample frames, rows of points and static points for a step."""
    frame_key, row_key, still_key = jax.random.split(key, 3)
    together = min(FRAMES_AT_ONCE, frames)
    frame = jax.random.choice(frame_key, frames, (together,), replace=False)
    rows = jax.random.randint(row_key, (POINTS_AT_ONCE,), 0, len(paths.known))
    static = jnp.asarray(paths.static)
    if len(static):
        static = static[jax.random.randint(still_key, (STILL_AT_ONCE,), 0, len(static))]
    return frame, rows, static


def _means(moving, resting, weight):
    """Compute the mean distances of known points and of static points."""
    return _mean(moving, weight), jnp.sum(resting) / max(resting.size, 1)


def _mean(values, weight):
    return jnp.sum(values * weight) / jnp.maximum(jnp.sum(weight), 1)


def _first_places(paths):
    """Return the position of each point in the middle of its known times."""
    places = np.zeros((len(paths.known), 3), np.float32)
    for row, valid in enumerate(paths.known):
        frames = np.flatnonzero(valid)
        places[row] = paths.position[row, frames[len(frames) // 2]]
    return places
