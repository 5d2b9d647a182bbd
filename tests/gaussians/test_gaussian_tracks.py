"""Points carried by Gaussians, against closed forms."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform

from gaussians_jax.core.splats import Gaussians, Params, deactivate
from gaussians_jax.scene import gaussian_tracks
from gaussians_jax.scene import scene as splat_scene
from nerfies_jax.capture import synthetic
from nerfies_jax.evaluation import protocol
from nerfies_jax.training.model import Model, Stages
from tests import scenes
from tests.gaussians.shared import put, rows_of


@pytest.fixture(scope="module")
def known_scene():
    spec = dataclasses.replace(scenes.TINY_SCENE, heldout_every=2)
    capture, truth = synthetic.make(spec)
    return capture, truth, protocol.ground_truth(capture, truth, 2, 5)


def splat_rows(mean, logit):
    """Splats of which only the place and the opacity matter."""
    unit = np.ones((len(mean), 4)), np.ones((len(mean), 3)), None
    return rows_of(Gaussians(np.float32(mean), *unit), logit)


def follow_moved(monkeypatch, known_scene, rows, moved):
    """Follow through Gaussians that `moved(mean, time)` poses in closed form."""
    capture, _, known = known_scene

    def deform(params, prepared, time):
        splats = params.rows["splats"]
        opacity = jax.nn.sigmoid(splats.opacity_logit)
        mean = moved(splats.mean, time) + 0 * prepared
        return Gaussians(mean, splats.quaternion, jnp.exp(splats.log_scale), opacity)

    stages = Stages(lambda params: jnp.zeros(()), deform, None)
    model = Model(None, None, None, None, (), None, stages=stages)
    monkeypatch.setattr(splat_scene, "build", lambda *_: model)
    effects = (types.SimpleNamespace(deform=deform),)
    monkeypatch.setattr(splat_scene, "all_effects", lambda *_: effects)
    state = types.SimpleNamespace(params=Params({"splats": rows}, {}))
    return gaussian_tracks.follow(None, None, state, capture, known)


@pytest.fixture
def cloud(known_scene, rng):
    """Gaussians all around the known points and the static ones."""
    capture, _, known = known_scene
    near = np.concatenate([known.start_points, capture.points.position])
    return near.repeat(20, 0) + rng.normal(scale=0.01, size=(20 * len(near), 3))


def test_points_are_carried_by_gaussians_that_all_move_alike(
    known_scene, monkeypatch, cloud
):
    capture, _, known = known_scene
    velocity = np.float32([0.3, 0.1, -0.2])
    rows = splat_rows(cloud, np.zeros(len(cloud)))
    followed = follow_moved(
        monkeypatch, known_scene, rows, lambda mean, time: mean + velocity * time
    )
    since = (
        capture.times[known.track_rows] - capture.times[known.track_rows][known.start]
    )
    expected = known.start_points[:, None] + since[:, None] * velocity
    np.testing.assert_allclose(followed.path, expected, atol=1e-6)
    assert followed.converged.all()
    assert followed.converged.shape == followed.path.shape[:2]
    assert np.isnan(followed.strain)
    away = since - since.mean()  # how far a static point is from its mean
    drift = np.abs(away).mean() * np.linalg.norm(velocity)
    assert followed.drift == pytest.approx(drift, rel=1e-4)


def test_a_turning_body_carries_its_points_but_for_the_way_to_the_neighbors_mean(
    known_scene, monkeypatch, cloud
):
    """x(t) = R(t) x with a turn of t radians about an axis through the origin."""
    capture, _, known = known_scene
    axis = np.float32([0.6, 0.0, 0.8])

    def turned(points, time):
        turn = scipy.spatial.transform.Rotation.from_rotvec(axis * float(time))
        return np.float32(turn.apply(points))

    def moved(mean, time):
        shape = jax.ShapeDtypeStruct(mean.shape, mean.dtype)
        return jax.pure_callback(turned, shape, mean, time)

    times = capture.times[known.track_rows]
    # Turned back, so that they are around the points when these are given.
    rows = splat_rows(turned(cloud, -times[known.start]), np.zeros(len(cloud)))
    followed = follow_moved(monkeypatch, known_scene, rows, moved)
    body = turned(known.start_points, -times[known.start])
    right = np.stack([turned(body, time) for time in times], axis=1)
    error = np.linalg.norm(followed.path - right, axis=-1)
    assert error[:, known.start].max() == pytest.approx(0, abs=1e-6)
    # The mean of eight of twenty neighbors 0.01 away lies some 0.003 beside the point.
    turn = 2 * np.abs(np.sin((times - times[known.start]) / 2))
    assert np.all(error <= 0.01 * turn + 1e-6)
    still = np.linalg.norm(right - known.start_points[:, None], axis=-1)
    assert error[:, -1].mean() < 0.05 * still[:, -1].mean()


def test_what_cannot_be_seen_carries_nothing(known_scene, monkeypatch, cloud):
    """Faint and dead Gaussians fly off; those that can be seen stay."""
    known = known_scene[2]
    mean = np.concatenate([cloud, cloud + 1e-4, cloud - 1e-4])
    logit = np.repeat([0.0, -4.0, 5.0], len(cloud))
    rows = splat_rows(mean, logit)
    hidden = np.arange(len(mean)) >= len(cloud)
    rows = deactivate(rows, put(np.arange(len(mean)) >= 2 * len(cloud)))

    def moved(mean, time):
        return jnp.where(hidden[:, None], mean + time, mean)

    followed = follow_moved(monkeypatch, known_scene, rows, moved)
    still = np.repeat(known.start_points[:, None], known.path.shape[1], 1)
    np.testing.assert_allclose(followed.path, still, atol=1e-6)
    none = splat_rows(cloud, np.full(len(cloud), -4.0))
    followed = follow_moved(
        monkeypatch, known_scene, none, lambda mean, time: mean + time
    )
    np.testing.assert_allclose(followed.path, still, atol=1e-6)


def test_the_weights_of_neighbors_are_a_slow_sum(rng):
    distance = np.sort(rng.uniform(size=(4, 8)), axis=1)
    opacity = rng.uniform(0.1, 1, size=(4, 8))
    weights = gaussian_tracks.neighbor_weights(distance, opacity)
    for row in range(4):
        expected = [
            opacity[row, k] / np.exp(2 * (distance[row, k] / distance[row, 7]) ** 2)
            for k in range(8)
        ]
        np.testing.assert_allclose(
            weights[row], expected / np.sum(expected), rtol=1e-12
        )
    # All at the point itself: by opacity alone.
    weights = gaussian_tracks.neighbor_weights(np.zeros((1, 2)), np.array([[0.3, 0.1]]))
    np.testing.assert_allclose(weights, [[0.75, 0.25]], rtol=1e-12)


@pytest.mark.full
def test_splats_without_motion_follow_nothing_and_untrained_motion_stays(known_scene):
    capture, _, known = known_scene
    metadata, spec = splat_scene.metadata_of(capture), scenes.TINY_DEFORMABLE
    still = gaussian_tracks.follow(scenes.TINY_SPLATS, metadata, None, capture, known)
    assert still is None
    state = splat_scene.build(spec, metadata).init(capture, jax.random.key(0))
    followed = gaussian_tracks.follow(spec, metadata, state, capture, known)
    # The heads begin near zero.
    np.testing.assert_allclose(
        followed.path,
        np.broadcast_to(known.start_points[:, None], known.path.shape),
        atol=1e-3,
    )
    assert followed.drift < 1e-3
