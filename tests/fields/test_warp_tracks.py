"""Points followed by the warp or the flow of a field, against closed forms."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial

from nerfies_jax.capture import synthetic
from nerfies_jax.evaluation import protocol
from nerfies_jax.fields.effects.effect import Medium
from nerfies_jax.fields.effects.records import FieldRecord
from nerfies_jax.scene import presets, scene, warp_tracks
from tests import scenes


@pytest.fixture(scope="module")
def known_scene():
    spec = dataclasses.replace(scenes.TINY_SCENE, heldout_every=2)
    capture, truth = synthetic.make(spec)
    return capture, truth, protocol.ground_truth(capture, truth, 2, 5)


@pytest.mark.parametrize("lost_at", [None, pytest.param(2, marks=pytest.mark.full)])
def test_points_are_followed_through_a_warp_in_closed_form(
    known_scene, monkeypatch, lost_at
):
    """x + d(x) = x / s(t) - v t: a point is scaled by s and moved, in field units."""
    capture, _, known = known_scene
    metadata = types.SimpleNamespace(center=(0.1, -0.2, 0.3), scale=4.0)
    times = capture.times[known.track_rows]
    velocity = jnp.asarray([0.3, 0.1, -0.2])

    def displace(params, point, condition):
        moved = point / (1 + condition.time) - params * condition.time - point
        if lost_at is None:
            return moved
        return jnp.where(abs(condition.time - times[lost_at]) < 1e-3, jnp.nan, moved)

    stub = types.SimpleNamespace(
        effects=(FieldRecord("warp", displace=displace),),
        codes_at=lambda params, view: {},
        displace=displace,
        numbers=None,
        with_numbers=None,
    )
    monkeypatch.setattr(scene, "field", lambda *_, **__: stub)
    state = types.SimpleNamespace(params=velocity, step=jnp.int32(5))
    followed = warp_tracks.follow(None, metadata, state, capture, known)

    start = 4.0 * (known.path[:, 3] - np.float32(metadata.center))
    template = start / (1 + times[3]) - np.asarray(velocity) * times[3]
    for column, time in enumerate(times):
        place = (template + np.asarray(velocity) * time) * (1 + time)
        place = place / 4.0 + np.float32(metadata.center)
        if column == lost_at:
            place = known.path[:, 3]
        np.testing.assert_allclose(followed.path[:, column], place, atol=3e-6)
        assert followed.converged[:, column].all() == (column != lost_at)
    if lost_at is None:
        stretch = np.sqrt(np.mean(3 * np.log(1 / (1 + times)) ** 2))
        assert followed.strain == pytest.approx(stretch, rel=1e-4)
        still = 4.0 * (capture.points.position - np.float32(metadata.center))
        moved = still / (1 + times[:, None, None]) - still
        moved = moved - np.asarray(velocity) * times[:, None, None]
        drift = np.linalg.norm(moved - moved.mean(0), axis=-1).mean() / 4.0
        assert followed.drift == pytest.approx(drift, rel=1e-4)


@pytest.mark.parametrize(("moving", "every"), [(0.75, 1), (1.0, 2)])
def test_points_are_followed_along_a_flow_in_closed_form(
    known_scene, moving, every, monkeypatch
):
    """A turn about an axis, by so much in each interval, of a share of what is there.

    With `every` second time known, the flow is followed over two intervals at once.
    """
    capture, _, known = known_scene
    chosen = np.arange(known.start % every, len(known.track_rows), every)
    known = known._replace(
        track_rows=known.track_rows[chosen],
        path=known.path[:, chosen],
        visible=known.visible[:, chosen],
        start=known.start // every,
    )
    spec = dataclasses.replace(presets.PRESETS["nsff-small"], scene_flow=None)
    metadata = scene.metadata_of(capture, spec)
    turn = scipy.spatial.transform.Rotation.from_rotvec([0.02, -0.05, 0.03]).as_matrix()
    both = jnp.asarray(np.stack([turn, turn.T]) - np.eye(3), jnp.float32)

    def medium(_, sample, __):
        # All weights of the template are zero below: its density is softplus(0).
        density = jnp.log(2.0) * (moving / (1 - moving) if moving < 1 else 1.0)
        forward, backward = both @ sample.point
        return Medium(
            density,
            jnp.zeros(3),
            share=jnp.float32(0.0 if moving < 1 else 99.0),
            extras={"flow_forward": forward, "flow_backward": backward},
        )

    effect = FieldRecord("scene_flow", medium=medium)
    whole = functools.partial(scene.field, effects=(effect,))
    monkeypatch.setattr(scene, "field", whole)
    field = scene.field(spec, metadata)
    shapes = jax.eval_shape(field.init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    state = types.SimpleNamespace(params=params, step=jnp.int32(0))
    followed = warp_tracks.follow(spec, metadata, state, capture, known)
    center = np.asarray(metadata.center)
    for column, row in enumerate(chosen):
        hops = int(row) - int(chosen[known.start])
        each = np.eye(3) + moving * ((turn if hops >= 0 else turn.T) - np.eye(3))
        step = np.linalg.matrix_power(each, abs(hops))
        expected = (known.start_points - center) @ step.T + center
        np.testing.assert_allclose(followed.path[:, column], expected, atol=2e-6)
    assert followed.converged.all()
    assert followed.drift > 0.01
    errors = protocol.score_tracks(known, followed)
    assert 0 < errors["tracks.epe"] != protocol.static_error(known)


def test_a_field_without_a_motion_follows_nothing(known_scene):
    capture, _, known = known_scene
    spec = presets.PRESETS["t-nerf-small"]
    metadata = scene.metadata_of(capture, spec)
    assert warp_tracks.follow(spec, metadata, None, capture, known) is None
