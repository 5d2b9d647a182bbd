"""Points followed by the warp of a field, against closed forms."""

import dataclasses
import types

import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import point_tracks, presets, scene
from nerfies_jax.capture import synthetic
from nerfies_jax.evaluation import protocol
from nerfies_jax.training.effects import Effect
from tests import scenes


@pytest.fixture(scope="module")
def filmed():
    film = dataclasses.replace(scenes.TINY_FILM, heldout_every=2)
    capture, truth = synthetic.make(film)
    return capture, truth, protocol.ground_truth(capture, truth, 2, 5)


@pytest.mark.parametrize("lost_at", [None, pytest.param(2, marks=pytest.mark.full)])
def test_points_are_followed_through_a_warp_in_closed_form(
    filmed, monkeypatch, lost_at
):
    """x + d(x) = x / s(t) - v t: a point is scaled by s and moved, in field units."""
    capture, _, known = filmed
    metadata = types.SimpleNamespace(centre=(0.1, -0.2, 0.3), scale=4.0)
    times = capture.times[known.moments]
    velocity = jnp.asarray([0.3, 0.1, -0.2])

    def displace(params, point, moment):
        moved = point / (1 + moment.time) - params * moment.time - point
        if lost_at is None:
            return moved
        return jnp.where(abs(moment.time - times[lost_at]) < 1e-3, jnp.nan, moved)

    stub = types.SimpleNamespace(
        effects=(Effect("warp", displace=displace),),
        codes_at=lambda params, view: {},
        displace=displace,
    )
    monkeypatch.setattr(scene, "field", lambda *_, **__: stub)
    state = types.SimpleNamespace(params=velocity, step=jnp.int32(5))
    followed = point_tracks.follow(None, metadata, state, capture, known)

    start = 4.0 * (known.path[:, 3] - np.float32(metadata.centre))
    template = start / (1 + times[3]) - np.asarray(velocity) * times[3]
    for column, time in enumerate(times):
        place = (template + np.asarray(velocity) * time) * (1 + time)
        place = place / 4.0 + np.float32(metadata.centre)
        if column == lost_at:
            place = known.path[:, 3]
        np.testing.assert_allclose(followed.path[:, column], place, atol=3e-6)
        assert followed.found[:, column].all() == (column != lost_at)
    if lost_at is None:
        stretch = np.sqrt(np.mean(3 * np.log(1 / (1 + times)) ** 2))
        assert followed.strain == pytest.approx(stretch, rel=1e-4)
        still = 4.0 * (capture.points.position - np.float32(metadata.centre))
        moved = still / (1 + times[:, None, None]) - still
        moved = moved - np.asarray(velocity) * times[:, None, None]
        drift = np.linalg.norm(moved - moved.mean(0), axis=-1).mean() / 4.0
        assert followed.drift == pytest.approx(drift, rel=1e-4)


def test_a_field_without_a_warp_follows_nothing(filmed):
    capture, _, known = filmed
    spec = presets.PRESETS["t-nerf-small"]
    metadata = scene.metadata_of(capture, spec)
    assert point_tracks.follow(spec, metadata, None, capture, known) is None
