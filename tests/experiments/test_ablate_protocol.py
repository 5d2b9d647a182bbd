"""The ablation's protocol against closed forms."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform

from experiments.ablate import measures
from experiments.ablate import picture as ablate_picture
from gaussians_jax import scene as splat_scene
from gaussians_jax.splats import Gaussians, Params, Splats, bury
from nerfies_jax import scene
from nerfies_jax.capture import synthetic
from nerfies_jax.effects.effect import Effect
from nerfies_jax.evaluation import protocol
from nerfies_jax.evaluation.protocol import Followed
from nerfies_jax.measure import geometry_quality
from nerfies_jax.runs import representations
from nerfies_jax.training.model import Stages
from tests import scenes

SHIFT = np.float32([0.012, 0.0, 0.016])  # 0.02 long


@pytest.fixture(scope="module")
def filmed():
    film = dataclasses.replace(scenes.TINY_FILM, heldout_every=2)
    capture, truth = synthetic.make(film)
    return capture, truth, protocol.known(capture, truth, 2, 5)


def test_the_known_paths_are_those_of_points_seen_at_the_start(filmed):
    capture, truth, known = filmed
    assert known.path.shape == (5, len(capture.train), 3)
    assert len(known.rows) == 2
    assert set(known.rows) <= set(capture.heldout)
    assert np.all(np.diff(capture.times[known.moments]) > 0)
    assert known.start == len(known.moments) // 2
    assert known.seen[:, known.start].all()
    for point, seen in zip(known.path, known.seen, strict=True):
        (track,) = np.flatnonzero((truth.track_canonical == point[0]).all(axis=1))
        np.testing.assert_array_equal(point, truth.track_world[track])
        np.testing.assert_array_equal(seen, truth.track_seen[track][known.moments])


def test_a_scaled_capture_has_its_paths_in_scene_units(filmed):
    capture, truth, known = filmed
    other = dataclasses.replace(capture, scale=2.0, centre=(0.1, 0.2, -0.3))
    found = protocol.known(other, truth, 2, 5)
    expected = 2 * (known.path - np.float32([0.1, 0.2, -0.3]))
    np.testing.assert_allclose(found.path, expected, atol=1e-6)


def test_the_truth_of_another_capture_is_refused(filmed):
    capture, truth, _ = filmed
    with pytest.raises(ValueError, match="other frames than the capture"):
        protocol.known(capture, truth._replace(ids=truth.ids[1:]), 2, 5)


def test_tracks_are_scored_by_their_distance_at_all_instants_but_the_start(filmed):
    known = filmed[2]._replace(seen=np.ones_like(filmed[2].seen))
    found = np.ones(known.seen.shape, bool)
    found[0, 4:6] = False
    right = Followed(known.path, found, 0.1, 0.2)
    later = found[:, 1:].size  # all but one column
    numbers = protocol.score_tracks(known, right)
    assert numbers["track_error"] == 0
    assert numbers["track_correct"] == 1
    assert numbers["track_lost"] == pytest.approx(2 / later)
    assert (numbers["drift"], numbers["strain"]) == (0.1, 0.2)
    wrong = right._replace(path=known.path + SHIFT)
    numbers = protocol.score_tracks(known, wrong)
    assert numbers["track_error"] == pytest.approx(0.02, rel=1e-4)
    assert numbers["track_correct"] == 0
    # What cannot be seen is not scored.
    half = known.seen.copy()
    half[:, ::2] = False
    wrong.path[:, ::2] = 9.0
    numbers = protocol.score_tracks(known._replace(seen=half), wrong)
    assert numbers["track_error"] == pytest.approx(0.02, rel=1e-4)
    away = np.linalg.norm(known.path - known.path[:, 3:4], axis=-1)
    away = np.delete(away, 3, axis=1)
    assert protocol.still_error(known) == pytest.approx(away.mean(), rel=1e-5)
    assert away.mean() > 1e-3
    nothing = protocol.score_tracks(known, None)
    assert np.isnan(list(nothing.values())).all()


@pytest.mark.parametrize("lost_at", [None, 2])
def test_points_are_followed_through_a_warp_in_closed_form(
    filmed, monkeypatch, lost_at
):
    """x + d(x) = x / s(t) - v t: a point is scaled by s and moved, in field units."""
    capture, _, known = filmed
    facts = types.SimpleNamespace(centre=(0.1, -0.2, 0.3), scale=4.0)
    times = capture.times[known.moments]
    velocity = jnp.asarray([0.3, 0.1, -0.2])

    def displace(params, point, moment):
        moved = point / (1 + moment.time) - params * moment.time - point
        if lost_at is None:
            return moved
        return jnp.where(abs(moment.time - times[lost_at]) < 1e-3, jnp.nan, moved)

    made = types.SimpleNamespace(
        effects=(Effect("warp", displace=displace),),
        codes_at=lambda params, view: {},
        displace=displace,
    )
    monkeypatch.setattr(scene, "field", lambda spec, facts: made)
    state = types.SimpleNamespace(params=velocity, step=jnp.int32(5))
    followed = protocol.follow_fields(None, facts, state, capture, known)

    start = 4.0 * (known.path[:, 3] - np.float32(facts.centre))
    template = start / (1 + times[3]) - np.asarray(velocity) * times[3]
    for column, time in enumerate(times):
        place = (template + np.asarray(velocity) * time) * (1 + time)
        place = place / 4.0 + np.float32(facts.centre)
        if column == lost_at:
            place = known.path[:, 3]
        np.testing.assert_allclose(followed.path[:, column], place, atol=3e-6)
        assert followed.found[:, column].all() == (column != lost_at)
    if lost_at is None:
        stretch = np.sqrt(np.mean(3 * np.log(1 / (1 + times)) ** 2))
        assert followed.strain == pytest.approx(stretch, rel=1e-4)
        still = 4.0 * (capture.points.position - np.float32(facts.centre))
        moved = still / (1 + times[:, None, None]) - still
        moved = moved - np.asarray(velocity) * times[:, None, None]
        drift = np.linalg.norm(moved - moved.mean(0), axis=-1).mean() / 4.0
        assert followed.drift == pytest.approx(drift, rel=1e-4)


def test_a_field_without_a_warp_follows_nothing(filmed):
    capture, _, known = filmed
    kind = representations.of_preset("t-nerf-small")
    spec = kind.presets["t-nerf-small"]
    facts = kind.facts_of(capture, spec)
    assert protocol.follow_fields(spec, facts, None, capture, known) is None


def test_the_picture_shows_how_far_points_are_from_where_they_should_be(filmed):
    capture, _, known = filmed
    shown = ablate_picture.shown_row(known, capture)
    row = known.rows[shown]
    colour = {"a": capture.images[row]}

    def apart(path):
        picture = ablate_picture.draw(
            capture,
            known,
            colour,
            {"a": capture.depths[row]},
            {"a": path},
            {"a": ""},
            shown,
        )
        assert picture.shape[1] > 4 * ablate_picture.WIDTH
        return np.sum(np.all(picture == ablate_picture.APART, axis=-1))

    assert apart(known.path) == 0
    near, far = apart(known.path + SHIFT), apart(known.path + 4 * SHIFT)
    assert 0 < near < far
    assert apart(None) == apart(np.repeat(known.path[:, 3:4], known.path.shape[1], 1))


def splat_rows(mean, logit):
    """Splats of which only the place and the opacity matter."""
    count = len(mean)
    return Splats(
        mean=jnp.asarray(mean, jnp.float32),
        log_scale=jnp.zeros((count, 3)),
        quaternion=jnp.tile(jnp.asarray([1.0, 0.0, 0.0, 0.0]), (count, 1)),
        opacity_logit=jnp.asarray(logit, jnp.float32),
        sh_dc=jnp.zeros((count, 1, 3)),
        sh_rest=jnp.zeros((count, 0, 3)),
    )


def follow_moved(monkeypatch, filmed, rows, moved):
    """Follow through Gaussians that `moved(mean, time)` poses in closed form."""
    capture, _, known = filmed

    def pose(params, prepared, time):
        splats = params.rows["splats"]
        opacity = jax.nn.sigmoid(splats.opacity_logit)
        mean = moved(splats.mean, time) + 0 * prepared
        return Gaussians(mean, splats.quaternion, jnp.exp(splats.log_scale), opacity)

    stages = Stages(lambda params: jnp.zeros(()), pose, None)
    monkeypatch.setattr(
        splat_scene, "build", lambda *_: types.SimpleNamespace(stages=stages)
    )
    effects = (types.SimpleNamespace(deform=pose),)
    monkeypatch.setattr(splat_scene, "effects_of", lambda *_: effects)
    state = types.SimpleNamespace(params=Params({"splats": rows}, {}))
    return protocol.follow_splats(None, None, state, capture, known)


@pytest.fixture
def cloud(filmed, rng):
    """Gaussians all around the known points and the static ones."""
    capture, _, known = filmed
    near = np.concatenate([known.start_points, capture.points.position])
    return near.repeat(20, 0) + rng.normal(scale=0.01, size=(20 * len(near), 3))


def test_points_are_carried_by_gaussians_that_all_move_alike(
    filmed, monkeypatch, cloud
):
    capture, _, known = filmed
    velocity = np.float32([0.3, 0.1, -0.2])
    rows = splat_rows(cloud, np.zeros(len(cloud)))
    followed = follow_moved(
        monkeypatch, filmed, rows, lambda mean, time: mean + velocity * time
    )
    since = capture.times[known.moments] - capture.times[known.moments][known.start]
    expected = known.start_points[:, None] + since[:, None] * velocity
    np.testing.assert_allclose(followed.path, expected, atol=1e-6)
    assert followed.found.all()
    assert np.isnan(followed.strain)
    away = since - since.mean()  # how far a static point is from its mean
    drift = np.abs(away).mean() * np.linalg.norm(velocity)
    assert followed.drift == pytest.approx(drift, rel=1e-4)


def test_a_turning_body_carries_its_points_but_for_the_way_to_the_neighbours_mean(
    filmed, monkeypatch, cloud
):
    """x(t) = R(t) x with a turn of t radians about an axis through the origin."""
    capture, _, known = filmed
    axis = np.float32([0.6, 0.0, 0.8])

    def turned(points, time):
        turn = scipy.spatial.transform.Rotation.from_rotvec(axis * float(time))
        return np.float32(turn.apply(points))

    def moved(mean, time):
        shape = jax.ShapeDtypeStruct(mean.shape, mean.dtype)
        return jax.pure_callback(turned, shape, mean, time)

    times = capture.times[known.moments]
    # Turned back, so that they are around the points when these are given.
    rows = splat_rows(turned(cloud, -times[known.start]), np.zeros(len(cloud)))
    followed = follow_moved(monkeypatch, filmed, rows, moved)
    body = turned(known.start_points, -times[known.start])
    right = np.stack([turned(body, time) for time in times], axis=1)
    error = np.linalg.norm(followed.path - right, axis=-1)
    assert error[:, known.start].max() == pytest.approx(0, abs=1e-6)
    # The mean of eight of twenty neighbours 0.01 away lies some 0.003 beside the point.
    turn = 2 * np.abs(np.sin((times - times[known.start]) / 2))
    assert np.all(error <= 0.01 * turn + 1e-6)
    still = np.linalg.norm(right - known.start_points[:, None], axis=-1)
    assert error[:, -1].mean() < 0.05 * still[:, -1].mean()


def test_what_cannot_be_seen_carries_nothing(filmed, monkeypatch, cloud):
    """Faint and dead Gaussians fly off; those that can be seen stay."""
    known = filmed[2]
    mean = np.concatenate([cloud, cloud + 1e-4, cloud - 1e-4])
    logit = np.repeat([0.0, -4.0, 5.0], len(cloud))
    rows = splat_rows(mean, logit)
    hidden = jnp.arange(len(mean)) >= len(cloud)
    rows = bury(rows, jnp.arange(len(mean)) >= 2 * len(cloud))

    def moved(mean, time):
        return jnp.where(hidden[:, None], mean + time, mean)

    followed = follow_moved(monkeypatch, filmed, rows, moved)
    still = np.repeat(known.start_points[:, None], known.path.shape[1], 1)
    np.testing.assert_allclose(followed.path, still, atol=1e-6)
    none = splat_rows(cloud, np.full(len(cloud), -4.0))
    followed = follow_moved(monkeypatch, filmed, none, lambda mean, time: mean + time)
    np.testing.assert_allclose(followed.path, still, atol=1e-6)


def test_the_weights_of_neighbours_are_a_slow_sum(rng):
    distance = np.sort(rng.uniform(size=(4, 8)), axis=1)
    opacity = rng.uniform(0.1, 1, size=(4, 8))
    found = protocol.neighbour_weights(distance, opacity)
    for row in range(4):
        expected = [
            opacity[row, k] / np.exp(2 * (distance[row, k] / distance[row, 7]) ** 2)
            for k in range(8)
        ]
        np.testing.assert_allclose(found[row], expected / np.sum(expected), rtol=1e-12)
    # All at the point itself: by opacity alone.
    found = protocol.neighbour_weights(np.zeros((1, 2)), np.array([[0.3, 0.1]]))
    np.testing.assert_allclose(found, [[0.75, 0.25]], rtol=1e-12)


def test_splats_without_motion_follow_nothing_and_untrained_motion_stays(filmed):
    capture, _, known = filmed
    facts = splat_scene.facts_of(capture)
    still = protocol.follow_splats(scenes.TINY_SPLATS, facts, None, capture, known)
    assert still is None
    model = splat_scene.build(scenes.TINY_DEFORMABLE, facts)
    state = model.init(capture, jax.random.key(0))
    followed = protocol.follow_splats(
        scenes.TINY_DEFORMABLE, facts, state, capture, known
    )
    assert followed.path.shape == known.path.shape
    errors = geometry_quality.track_errors(
        jnp.asarray(followed.path),
        jnp.asarray(np.repeat(known.start_points[:, None], followed.path.shape[1], 1)),
        jnp.ones(known.seen.shape, bool),
        0.01,
    )
    assert errors.endpoint < 1e-3  # the heads begin near zero
    assert followed.drift < 1e-3


def test_a_real_capture_is_judged_by_its_pictures_alone(filmed):
    capture, _, known = filmed
    found = protocol.filmed(capture, 2)
    np.testing.assert_array_equal(found.rows, known.rows)
    np.testing.assert_array_equal(found.moments, known.moments)

    measured = {key: 1.0 for key in measures.KEYS.values()}
    numbers = measures.quality(measured, found.exact)
    assert (numbers["psnr"], numbers["ssim"]) == (1, 1)
    assert np.isnan([numbers[name] for name in measures.ESTIMATED]).all()
    assert set(numbers) == set(measures.KEYS)
    assert measures.quality(measured, True) == dict.fromkeys(measures.KEYS, 1.0)
    assert np.isnan(list(protocol.score_tracks(found, None).values())).all()
    assert np.isnan(protocol.still_error(found))
    blind = dataclasses.replace(
        capture, train=np.arange(len(capture.ids)), heldout=np.zeros(0, int)
    )
    with pytest.raises(ValueError, match="no held-out frames to judge by"):
        protocol.filmed(blind, 2)
    shown = ablate_picture.shown_row(found, capture)
    row = found.rows[shown]
    picture = ablate_picture.draw(
        capture,
        found,
        {"a": capture.images[row], "b": capture.images[row]},
        {"a": capture.depths[row], "b": capture.depths[row]},
        {"a": None, "b": None},
        {"a": "", "b": ""},
        shown,
    )
    assert picture.shape[1] > 4 * ablate_picture.WIDTH
