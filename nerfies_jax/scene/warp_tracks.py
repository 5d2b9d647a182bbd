"""Point tracks by the warp or the scene flow of a radiance field."""

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.model_flow import Move, Moved
from nerfies_jax.evaluation.protocol import STATIC_POINTS, GroundTruth, PointTracks
from nerfies_jax.fields.effects import scene_flow, timestamps
from nerfies_jax.fields.render_ray import Bound, mean_flow
from nerfies_jax.scene import scene
from nerfies_jax.training import programs, tracks
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.model import in_default_precision

LEAST_STRETCH = 1e-6  # bounds the logarithm of collapsed directions


def follow(
    spec,
    metadata,
    state,
    capture: Capture,
    truth: GroundTruth,
) -> PointTracks | None:
    """Track points from the start to all other times through the template of a field.

    A point is mapped to the template by the warp at the start, and from there by the
    inverse warp at every other time. Without a warp, points follow the scene flow from
    each time to the next, and the strain is undefined.

    Args:
      spec: The scene.
      metadata: Scene metadata.
      state: Trained state, of `scene.build`.
      capture: The capture.
      truth: Ground truth, whose start points are tracked.

    Returns:
      The tracks in scene units. None without such motion or without points.
    """
    field = scene.field(spec, metadata)
    if not len(truth.path):
        return None
    if all(effect.displace is None for effect in field.effects):
        return _follow_flow(field, state, capture, truth)
    views = [evaluation.view_of(capture, int(row)) for row in truth.track_rows]
    views = jax.tree.map(lambda *leaves: np.stack(leaves), *views)
    center = np.asarray(metadata.center, np.float32)

    def to_field(points):
        return in_default_precision((points - center) * np.float32(metadata.scale))

    static = _static_points(capture)

    def solve(field, params, step, views, start, true, static):
        def condition_of(view):
            return FrameCondition(view.time, field.codes_at(params, view), step)

        conditions = jax.vmap(condition_of)(views)
        result = tracks.point_tracks(
            field.displace, params, start, conditions, truth.start
        )
        each = jax.vmap(field.displace, (None, 0, None))  # point
        shift = jax.vmap(each, (None, None, 0))(params, static, conditions)
        grad = jax.vmap(jax.jacfwd(field.displace, 1), (None, 0, None))
        grads = jax.vmap(grad, (None, 1, 0))(params, true, conditions)
        apart = jnp.linalg.norm(shift - jnp.mean(shift, axis=0), axis=-1)
        return result, apart, grads

    result, apart, grads = jax.device_get(
        programs.Program(solve, field)(
            state.params,
            state.step,
            views,
            to_field(truth.start_points),
            to_field(truth.path),
            to_field(static),
        )
    )
    path = result.points / np.float32(metadata.scale) + center
    still_path = truth.start_points[:, None]
    path = np.where(result.converged[..., None], path, still_path)
    stretch = np.linalg.svd(np.eye(3) + grads.astype(float), compute_uv=False)
    strain = np.log(np.maximum(stretch, LEAST_STRETCH))
    return PointTracks(
        path=path.astype(np.float32),
        converged=result.converged,
        drift=float(apart.mean() / metadata.scale) if apart.size else float("nan"),
        strain=float(np.sqrt(np.mean(np.sum(strain**2, axis=-1)))),
    )


def _static_points(capture):
    if capture.points is None:
        return np.zeros((0, 3), np.float32)
    return capture.points.position[:STATIC_POINTS]


def _follow_flow(field, state, capture, truth):
    """Track forward and backward by scene flow. Return None without a scene flow."""
    move = _flow_mover(field)
    if move is None:
        return None
    views = [evaluation.view_of(capture, int(row)) for row in truth.track_rows]
    static = _static_points(capture)
    begin = np.concatenate([truth.start_points, static])
    places = {truth.start: Moved(begin, np.ones(len(begin), bool))}
    last = len(views) - 1
    for step, stop in ((1, last), (-1, 0)):
        for frame in range(truth.start, stop, step):
            before, following = places[frame], frame + step
            step_result = move(state, before.points, views[frame], views[following])
            places[following] = Moved(
                step_result.points, before.converged & step_result.converged
            )
    count = len(truth.path)
    path, valid = (
        np.stack(each, axis=1)
        for each in zip(*(places[k] for k in range(len(views))), strict=True)
    )
    static_path = path[count:]
    apart = np.linalg.norm(
        static_path - static_path.mean(axis=1, keepdims=True), axis=-1
    )
    is_lost = ~valid[:count, :, None]
    return PointTracks(
        path=np.where(is_lost, truth.start_points[:, None], path[:count]).astype("f4"),
        converged=valid[:count],
        drift=float(apart.mean()) if apart.size else float("nan"),
        strain=float("nan"),
    )


def _flow_mover(field) -> Move | None:
    """Return a function that follows the scene flow interval by interval.

    If the time between two views is not a multiple of the interval, the flow of each
    hop is scaled. A point whose position becomes non-finite is lost.
    """
    if all(effect.name != scene_flow.NAME for effect in field.effects):
        return None
    metadata = field.metadata
    center = np.asarray(metadata.center, np.float32)
    gap = timestamps.interval(len(metadata.times))

    def hop(field, params, step, points, view, side, length):
        condition = FrameCondition(view.time, field.codes_at(params, view), step)
        bound = Bound(field.spec, field.metadata, field.effects, params)
        flow = jax.vmap(lambda point: mean_flow(bound, point, condition))(points)
        return points + length * flow[:, side]

    hop_program = programs.Program(hop, field)

    def move(state, points, source, target):
        begin, end = float(source.time), float(target.time)
        hops = max(round(abs(end - begin) / gap), 1)
        length = in_default_precision(np.float32(abs(end - begin) / (hops * gap)))
        side = scene_flow.FORWARD if end >= begin else scene_flow.BACKWARD
        place = in_default_precision((points - center) * np.float32(metadata.scale))
        for time in np.linspace(begin, end, hops, endpoint=False):
            view = source._replace(time=jnp.asarray(time, source.time.dtype))
            place = hop_program(state.params, state.step, place, view, side, length)
        target_points = np.asarray(place) / np.float32(metadata.scale) + center
        finite = np.isfinite(target_points).all(axis=1)
        return Moved(np.where(finite[:, None], target_points, points), finite)

    return move


def mover(spec, metadata) -> Move | None:
    """Return the motion of points from the time of one view to that of another.

    Args:
      spec: The scene.
      metadata: Scene metadata.

    Returns:
      The motion, or None if no effect of the scene moves points.
    """
    field = scene.field(spec, metadata)
    if all(effect.displace is None for effect in field.effects):
        return _flow_mover(field)
    center = np.asarray(metadata.center, np.float32)

    def solve(field, params, step, points, source, target):
        def condition_of(view):
            return FrameCondition(view.time, field.codes_at(params, view), step)

        views = jax.tree.map(lambda *leaves: jnp.stack(leaves), source, target)
        conditions = jax.vmap(condition_of)(views)
        paths = tracks.point_tracks(field.displace, params, points, conditions, 0)
        return paths.points[:, 1], paths.converged[:, 1]

    solve_program = programs.Program(solve, field)

    def move(state, points, source, target):
        inside = in_default_precision((points - center) * np.float32(metadata.scale))
        target_place, finite = jax.device_get(
            solve_program(state.params, state.step, inside, source, target)
        )
        position = target_place / np.float32(metadata.scale) + center
        return Moved(np.where(finite[:, None], position, points), finite)

    return move
