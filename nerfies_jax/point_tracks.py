"""Points followed through time by the warp of a radiance field."""

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax import evaluation, scene
from nerfies_jax.evaluation.model_flow import Move, Moved
from nerfies_jax.evaluation.protocol import STATIC_POINTS, PointTracks
from nerfies_jax.training import tracks
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.model import in_default_precision

LEAST_STRETCH = 1e-6  # a collapsed direction has a logarithm, too


def follow(spec, metadata, state, capture, known, effects=()) -> PointTracks | None:
    """Points of the start at all other moments, through the template of a field.

    A point goes to the template by the warp of the start, and from there by the inverse
    warp of every other moment.
    """

    field = scene.field(spec, metadata, effects=effects)
    if all(effect.displace is None for effect in field.effects) or not len(known.path):
        return None
    views = [evaluation.view_of(capture, int(row)) for row in known.moments]
    views = jax.tree.map(lambda *leaves: jnp.stack(leaves), *views)
    centre = np.asarray(metadata.centre, np.float32)

    def to_field(points):
        return in_default_precision((points - centre) * np.float32(metadata.scale))

    static = np.zeros((0, 3), np.float32)
    if capture.points is not None:
        static = capture.points.position[:STATIC_POINTS]

    @jax.jit
    def solve(params, step, start, true, static):
        def condition_of(view):
            return FrameCondition(view.time, field.codes_at(params, view), step)

        conditions = jax.vmap(condition_of)(views)
        followed = tracks.point_tracks(
            field.displace, params, start, conditions, known.start
        )
        each = jax.vmap(field.displace, (None, 0, None))  # point
        moved = jax.vmap(each, (None, None, 0))(params, static, conditions)
        grad = jax.vmap(jax.jacfwd(field.displace, 1), (None, 0, None))
        grads = jax.vmap(grad, (None, 1, 0))(params, true, conditions)
        apart = jnp.linalg.norm(moved - jnp.mean(moved, axis=0), axis=-1)
        return followed, apart, grads

    followed, apart, grads = jax.device_get(
        solve(
            state.params,
            state.step,
            to_field(known.start_points),
            to_field(known.path),
            to_field(static),
        )
    )
    path = followed.points / np.float32(metadata.scale) + centre
    still_path = known.start_points[:, None]
    path = np.where(followed.converged[..., None], path, still_path)
    stretch = np.linalg.svd(np.eye(3) + grads.astype(float), compute_uv=False)
    strain = np.log(np.maximum(stretch, LEAST_STRETCH))
    return PointTracks(
        path=path.astype(np.float32),
        found=followed.converged,
        drift=float(apart.mean() / metadata.scale) if apart.size else float("nan"),
        strain=float(np.sqrt(np.mean(np.sum(strain**2, axis=-1)))),
    )


def mover(spec, metadata, effects=()) -> Move | None:
    """What takes points of one view's moment to another's; None without a warp."""
    field = scene.field(spec, metadata, effects=effects)
    if all(effect.displace is None for effect in field.effects):
        return None
    centre = np.asarray(metadata.centre, np.float32)

    @jax.jit
    def solve(params, step, points, here, there):
        def condition_of(view):
            return FrameCondition(view.time, field.codes_at(params, view), step)

        views = jax.tree.map(lambda *leaves: jnp.stack(leaves), here, there)
        conditions = jax.vmap(condition_of)(views)
        tracked = tracks.point_tracks(field.displace, params, points, conditions, 0)
        return tracked.points[:, 1], tracked.converged[:, 1]

    def move(state, points, here, there):
        inside = in_default_precision((points - centre) * np.float32(metadata.scale))
        reached, known = jax.device_get(
            solve(state.params, state.step, inside, here, there)
        )
        moved = reached / np.float32(metadata.scale) + centre
        return Moved(np.where(known[:, None], moved, points), known)

    return move
