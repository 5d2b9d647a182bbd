"""Motions fitted to paths, and the Gaussians that they carry."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Params
from gaussians_jax.init import motion_fit
from gaussians_jax.init import tracks as track_start
from gaussians_jax.init.motion_fit import Depth, Paths, Points
from gaussians_jax.init.points import StartSpec
from gaussians_jax.motion import se3_bases, temporal_opacity
from gaussians_jax.motion.se3_bases import SE3BasesSpec
from gaussians_jax.scene import presets, scene, spec
from nerfies_jax import evaluation
from nerfies_jax.capture.capture import PointCloud
from nerfies_jax.preprocessing import hidden_points, record, usable_paths
from tests import compilations
from tests.gradients import directional_error
from tests.preprocessing import two_planes
from tests.preprocessing.test_tracks import MOVES, gathered

FRAMES = 24
MOTIONS = {
    "bases": SE3BasesSpec(bases=2, knots=6),
    "mlp": presets.SMALL_DEFORMABLE.motion,
    "kan": presets.SMALL_SONATA.motion,
    "basis": presets.SMALL_MOBA.motion,
    "polynomial": presets.SMALL_SPACETIME.motion,
    "spline": presets.SMALL_SPLINE.motion,
    "planes": presets.SMALL_FOUR_D.motion,
    "nodes": presets.SMALL_SC_GS.motion,
    "embedding": presets.SMALL_E_D3DGS.motion,
    "anchors": presets.SMALL_ADC_GS.motion,
}
BOX = ((-1.0, -1.0, 0.0), (1.0, 1.0, 2.0))


def turning_body():
    """[30, FRAMES, 3] points that turn by 80 degrees and shift."""
    rng = np.random.default_rng(0)
    time = np.linspace(0, 1, FRAMES)
    turn = Rotation.from_rotvec(1.4 * time[:, None] * [0, 0.6, 0.8]).as_matrix()
    points = rng.normal(0, 0.15, (30, 3))
    path = np.einsum("tij,nj->nti", turn, points) + np.array([0, 0, 1])
    return path + time[:, None] * [0.3, 0, 0], time.astype(np.float32)


def places_of(effect, points, time):
    """Of one time, or [times, points, 3] of many: one program for all of them."""

    def places(points, time):
        return motion_fit.positions_at(effect, points, time)

    many = jax.vmap(places, (None, 0)) if np.ndim(time) else places
    return jax.jit(many)(points, time)


def effect_of(motion):
    scene_spec = spec.SplatScene(steps=100, motion=motion)
    metadata = spec.SceneMetadata(1.0, (0.0, 0.0, 0.0), FRAMES, box=BOX)
    return spec.motion_of(scene_spec, metadata)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "bases" else pytest.mark.full)
        for name in MOTIONS
    ],
)
def test_every_motion_can_be_fitted_to_paths(name):
    position, time = turning_body()
    known = np.random.default_rng(1).uniform(size=position.shape[:2]) < 0.6
    effect = effect_of(MOTIONS[name])
    paths = Paths(time, position.astype(np.float32), known, 1.0)
    fitted = motion_fit.fit(effect, paths, jax.random.key(0), steps=600)
    assert fitted.last < 0.02
    middle = places_of(effect, fitted.points, time[FRAMES // 2])
    off = np.linalg.norm(middle - position[:, FRAMES // 2], axis=-1)
    # Also where a path was not known: it moves as its neighbors do.
    assert np.median(off) < 0.03


@pytest.mark.full
def test_a_fit_to_other_paths_compiles_nothing(tmp_path):
    position, time = turning_body()
    known = np.ones(position.shape[:2], bool)
    effect, counts = effect_of(MOTIONS["bases"]), []
    with compilations.counted(tmp_path) as since:
        for scale, count in ((1.0, 30), (1.1, 25)):
            path = (scale * position[:count]).astype(np.float32)
            depth = Depth(np.ones_like(path) / 3**0.5, np.full(count, 0.02))
            paths = Paths(time, path, known[:count], scale, depth=depth)
            motion_fit.fit(effect, paths, jax.random.key(int(9 * scale)), steps=10)
            counts.append(since())
    assert counts[0] > counts[1] == 0


@pytest.mark.full
def test_bases_are_held_outside_the_time_of_their_tracks():
    time = np.linspace(0, 1, FRAMES).astype(np.float32)
    points = np.random.default_rng(0).normal(0, 0.1, (30, 1, 3))
    position = points + time[:, None] * np.array([0.5, 0, 0]) + [0, 0, 1]
    known = np.tile((time > 0.3) & (time < 0.7), (30, 1))
    effect = effect_of(SE3BasesSpec(bases=1, knots=12))
    paths = Paths(time, position.astype(np.float32), known, 1.0)
    fitted = motion_fit.fit(effect, paths, jax.random.key(0), steps=600)
    places = places_of(effect, fitted.points, time)[..., 0]
    speed = np.median(np.diff(places, axis=0), axis=1) * (FRAMES - 1)
    np.testing.assert_allclose(speed[9:13], 0.5, atol=0.05)
    # Two knots beyond the last known frame, where a cubic spline is constant again.
    assert np.abs(speed[:3]).max() < 0.05
    assert np.abs(speed[-3:]).max() < 0.05


@pytest.mark.full
@pytest.mark.parametrize("name", ["mlp", "embedding"])  # the latter has rows
def test_networks_that_are_fitted_leave_the_wall_where_it_is(name, monkeypatch):
    """Also where the fit has not looked: points drawn apart."""
    monkeypatch.setattr(motion_fit, "RESTING", 64)
    position, time = turning_body()
    wall = np.random.default_rng(3).uniform(-1, 1, (400, 3)) * [1, 1, 0] + [0, 0, 2]
    effect = effect_of(MOTIONS[name])
    moved = []
    for still in (None, wall[:200].astype(np.float32)):
        known = np.ones(position.shape[:2], bool)
        paths = Paths(time, position.astype(np.float32), known, 1.0, still)
        fitted = motion_fit.fit(effect, paths, jax.random.key(0), steps=400)
        assert fitted.last < 0.03
        rest = Points(jnp.asarray(wall[200:], jnp.float32), None, fitted.points.nets)
        if still is not None and fitted.points.rows is not None:
            own = track_start.rows_at_rest(fitted.points.resting, rest.canonical)
            rest = rest._replace(rows=own)
        elif fitted.points.rows is not None:
            blank = motion_fit.scene_of(effect, rest).rows["splats"]
            own = effect.init(jax.random.key(9), blank).per_gaussian
            rest = rest._replace(rows=own)
        now = places_of(effect, rest, time[3])
        moved.append(np.median(np.linalg.norm(now - rest.canonical, axis=-1)))
    assert moved[1] < 0.02
    assert moved[1] < 0.5 * moved[0]


def test_a_motion_of_two_knots_is_straight_and_costs_nothing():
    position, time = turning_body()
    known = np.ones(position.shape[:2], bool)
    paths = Paths(time, position.astype(np.float32), known, 1.0)
    guess = se3_bases.fit_to_paths(SE3BasesSpec(bases=2, knots=2), paths)
    assert guess.penalty(guess.points, None) == 0


@pytest.mark.full
def test_wrong_paths_bend_nothing():
    position, time = turning_body()
    position = position.copy()
    position[:3] += np.random.default_rng(2).normal(0, 0.5, (3, FRAMES, 3))
    known = np.ones(position.shape[:2], bool)
    effect = effect_of(MOTIONS["bases"])
    paths = Paths(time, position.astype(np.float32), known, 1.0)
    fitted = motion_fit.fit(effect, paths, jax.random.key(0), steps=400)
    places = places_of(effect, fitted.points, time[5])
    assert np.linalg.norm(places - position[:, 5], axis=-1)[3:].max() < 0.05


def test_slopes_of_carried_points_are_those_of_differences(float64):
    effect = effect_of(MOTIONS["bases"])
    rng = np.random.default_rng(3)
    first = se3_bases.init(jax.random.key(0), MOTIONS["bases"])
    nets = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), first)
    points = Points(rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), nets)

    def value(points):
        return jnp.sum(motion_fit.positions_at(effect, points, jnp.float64(0.3)) ** 3)

    assert directional_error(value, points) < 1e-7


@pytest.mark.full
@pytest.mark.parametrize("deviation", [0.02, 1.0])
def test_a_thing_tells_its_depth_better_than_each_of_its_tracks(deviation):
    """Where the video tells depth; where it does not, tracks count as they are."""
    position, time = turning_body()
    ray = position / np.linalg.norm(position, axis=-1, keepdims=True)
    noise = np.random.default_rng(3).normal(0, 0.06, (30, 1, 1))
    wobble = np.sin(np.arange(FRAMES) / 3)[:, None] * noise
    tracked = (position + wobble * ray).astype(np.float32)
    known = np.ones(position.shape[:2], bool)
    effect = effect_of(MOTIONS["bases"])
    misses = []
    for depth in (None, Depth(ray, np.full(30, deviation))):
        paths = Paths(time, tracked, known, 1.0, depth=depth)
        points = motion_fit.fit(effect, paths, jax.random.key(0), steps=300).points
        off = np.moveaxis(places_of(effect, points, time), 0, 1) - position
        off -= off.mean(axis=1, keepdims=True)
        misses.append(np.mean(np.linalg.norm(off, axis=-1)))
    if deviation == 1.0:
        assert misses[1] == pytest.approx(misses[0], rel=1e-3)
    else:
        assert misses[1] < 0.7 * misses[0]


def test_depths_of_rigid_objects_count_like_their_place_in_the_image():
    deviation = np.array([0.0, 0.03, 0.15, np.inf])
    np.testing.assert_allclose(motion_fit.along(deviation), [0.03, 0.04, 1, 1])


def test_nothing_known_is_refused_by_name():
    position, time = turning_body()
    paths = Paths(time, position, np.zeros(position.shape[:2], bool), 1.0)
    with pytest.raises(ValueError, match="no path has a known"):
        motion_fit.fit(effect_of(MOTIONS["bases"]), paths, jax.random.key(0))


@pytest.mark.full
def test_gaussians_start_on_the_card_and_move_with_it():
    capture, evidence = gathered()
    effect = effect_of(MOTIONS["bases"])
    start = StartSpec(motion="tracks", moving_points=200, fit_steps=300)
    started = track_start.start(start, effect, evidence, capture, jax.random.key(0))
    assert len(started.position) == len(started.color) == len(started.rows) == 200
    points = Points(
        jnp.asarray(started.position), jnp.asarray(started.rows), started.nets
    )
    times = capture.times[evidence.row[[4, 12, 20]]]
    for time, place in zip(times, places_of(effect, points, times), strict=True):
        across, down = MOVES["card"](time)
        on_card = (
            np.abs(place[:, :2] - np.array([across, down])) < two_planes.CARD + 0.05
        ).all(-1)
        near = np.abs(place[:, 2] - two_planes.NEAR) < 0.15
        assert (on_card & near).mean() > 0.8  # the mask has a rim


@pytest.mark.full
def test_gaussians_start_on_one_surface_where_depths_of_paths_disagree():
    """Paths are too near and too far in turn, which a few knots do not follow."""
    capture, evidence = gathered()
    views = record.view_set.in_time_order(capture, evidence.row)
    factor = 1 + 0.03 * (-1.0) ** np.arange(len(views.row))
    offset = factor[:, None] * (evidence.paths.position - views.position)
    paths = evidence.paths._replace(
        position=views.position + offset, depth=factor * evidence.paths.depth
    )
    start = StartSpec(motion="tracks", moving_points=200, fit_steps=300)
    started = track_start.start(
        start,
        effect_of(MOTIONS["bases"]),
        evidence._replace(paths=paths),
        capture,
        jax.random.key(0),
    )
    depth = started.position[:, 2]
    spread = np.median(np.abs(depth - np.median(depth))) / two_planes.NEAR
    assert spread < 0.01, spread  # 0.03 with the depths of the paths


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_pixels_beyond_the_points_of_a_slanted_plane_are_on_it(dtype):
    rng = np.random.default_rng(5)
    offset = rng.uniform([1, -4], [8, 4], (50, 12, 2))  # all on one side of the pixel
    slope = rng.uniform(-0.01, 0.01, (50, 1, 2))
    inverse = 1.5 + (offset * slope).sum(-1)
    depth = (1 / inverse).astype(dtype)
    depth[:, 3] *= 0.7  # a wrong track
    plane = track_start._on_planes(offset.astype(dtype), depth)
    assert np.abs(1.5 * plane - 1).max() < 0.01
    median = np.median(depth, axis=1)
    assert np.abs(1.5 * plane - 1).mean() < 0.1 * np.abs(1.5 * median - 1).mean()


def test_moving_gaussians_are_thin_along_the_normal_of_their_surface():
    rng = np.random.default_rng(7)
    still = rng.normal(size=(9, 3)).astype(np.float32)
    normal = np.array([0.36, 0.48, 0.8])
    turn = Rotation.align_vectors([normal], [[0, 0, 1]])[0]
    flat = turn.apply(np.pad(rng.uniform(-1, 1, (60, 2)), [(0, 0), (0, 1)]))
    moving = (flat + np.array([0, 0, 3])).astype(np.float32)
    position = np.concatenate([still, moving])
    color = np.full(position.shape, 0.5)
    round_ones = splats.from_points(position, color)
    thin = track_start.flattened(round_ones, moving, 0.15)
    for own, every in zip(thin, round_ones, strict=True):
        np.testing.assert_array_equal(own[:9], every[:9])
        assert own.dtype == every.dtype
    axes = Rotation.from_quat(thin.quaternion[9:], scalar_first=True).as_matrix()
    half = axes * np.exp(thin.log_scale[9:])[:, None]  # a root of the covariance
    before = np.exp(np.asarray(round_ones.log_scale)[9:, 0])
    across = np.cross(normal, [1, 0, 0])
    for direction, share in ((normal, 0.15), (across / np.linalg.norm(across), 1)):
        deviation = np.linalg.norm(np.einsum("nij,i->nj", half, direction), axis=-1)
        np.testing.assert_allclose(deviation, share * before, rtol=1e-3)
    few = track_start.flattened(round_ones, moving[:3], 0.15)
    assert few is round_ones


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_that_determine_no_plane_give_their_depth(dtype):
    offset = np.zeros((3, 6, 2), dtype)  # in one place, in a line, and of two depths
    offset[1, :, 0] = np.arange(6)
    offset[2] = np.random.default_rng(6).uniform(-5, 5, (6, 2))
    depth = np.full((3, 6), 2.0, dtype)
    depth[2, 4:] = 3.0
    plane = track_start._on_planes(offset, depth)
    np.testing.assert_allclose(plane[:2], 2, rtol=1e-4)
    assert 1.7 < plane[2] < 3.5
    far = track_start._on_planes(offset[2:], np.array([[0.1] * 3 + [9.0] * 3], dtype))
    assert 0 < far < 20


def test_where_no_moving_pixel_has_a_depth_the_motion_starts_alone(monkeypatch):
    """As where fewer than six tracks are known in every frame."""
    capture, evidence = gathered()
    nowhere = np.zeros(evidence.moving.shape, np.float32)
    monkeypatch.setattr(track_start, "moving_depths", lambda *_: nowhere)
    effects = (effect_of(MOTIONS["bases"]),)
    start = StartSpec(motion="tracks", fit_steps=2)
    started = track_start.start(start, *effects, evidence, capture, jax.random.key(0))
    assert len(started.position) == len(started.color) == len(started.rows) == 0
    rows = splats.from_points(np.eye(3), np.eye(3))
    params = Params({"splats": rows, "se3_bases": jnp.ones((3, 13))}, {"se3_bases": 0})
    begun = track_start.put_in(params, effects, started)
    np.testing.assert_array_equal(begun.rows["se3_bases"], 1)
    assert begun.nets["se3_bases"].fine.turn.any()


def small_scene(**changes):
    return dataclasses.replace(
        presets.with_steps(presets.SMALL_TRACKED, 30),
        motion=MOTIONS["bases"],
        **changes,
    )


def test_a_scene_starts_from_the_evidence(tmp_path, monkeypatch):
    capture, evidence = gathered()
    monkeypatch.setattr(usable_paths, "CACHE", tmp_path)
    record.save(tmp_path / "evidence" / f"{record.digest(capture)}.npz", evidence)
    places = np.float32([[7, 0, 2], [8, 0, 2], [9, 0, 2]])
    guessed = PointCloud(places, np.full((3, 3), 51, "u1"))
    monkeypatch.setattr(hidden_points, "behind", lambda *_: guessed)
    start = StartSpec(motion="tracks", moving_points=150, fit_steps=100)
    spec_ = small_scene(start=start)
    # There is room for two of them under the cap.
    known = min(len(evidence.static_cloud.position), spec_.init.points)
    cap = dataclasses.replace(spec_.strategy, cap_max=known + 150 + 2)
    spec_ = dataclasses.replace(spec_, strategy=cap)
    model = scene.build(spec_, scene.metadata_of(capture))
    state = model.init(capture, jax.random.key(0))
    rows = state.params.rows
    active = np.asarray(splats.active_mask(rows["splats"]))
    still = np.asarray(jax.nn.softmax(rows["se3_bases"])[:, 0])
    assert (still[active] < 0.5).sum() >= 100
    assert (still[active] > 0.99).sum() == active.sum() - 150
    wall = np.asarray(rows["splats"].mean)[active & (still > 0.99)]
    assert abs(np.median(wall[:, 2]) - two_planes.FAR) < 0.05
    # What stands hidden begins opaque, in the color that was guessed.
    opaque = np.asarray(jax.nn.sigmoid(rows["splats"].opacity_logit)) > 0.8
    np.testing.assert_array_equal(rows["splats"].mean[opaque], places[::2])
    shade = 0.5 + splats.SH_DC * rows["splats"].sh_dc[opaque]
    np.testing.assert_allclose(shade, 0.2, atol=1e-6)
    assert (still[opaque] > 0.99).all()
    fading = jax.tree.map(np.asarray, rows["temporal_opacity"])
    lifted = active & (fading.log_width < temporal_opacity.ALWAYS)
    np.testing.assert_array_equal(lifted, active & (still < 0.99))
    assert np.isin(fading.time[lifted], capture.times.astype(np.float32)).all()
    quick = model.example(capture, jax.random.key(0))
    assert jax.tree.structure(quick) == jax.tree.structure(state)
    # It moves from its first step on.
    once, _ = jax.eval_shape(model.step, state, evaluation.frames_of(capture))
    assert jax.tree.structure(once) == jax.tree.structure(state)


def test_a_video_without_tracks_starts_from_rest_and_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(usable_paths, "CACHE", tmp_path)
    capture = two_planes.make(card=lambda time: (0.1, 0.0), frames=8)
    positions = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 3), (300, 3))
    points = PointCloud(positions.astype("f4"), np.zeros((300, 3), "u1"))
    capture = dataclasses.replace(capture, points=points)
    spec = small_scene(start=StartSpec(motion="tracks"))
    model = scene.build(spec, scene.metadata_of(capture))
    with pytest.warns(RuntimeWarning, match="of the pixels show moving objects"):
        state = model.init(capture, jax.random.key(0))
    # What might move has points of no other kind: random ones.
    active = splats.active_mask(state.params.rows["splats"]).sum()
    assert active == 300 + spec.init.points // 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"motion": "flow"}, "unknown motion"),
        ({"moving_points": 0}, "at least one moving point"),
        ({"thickness": 0.0}, "must lie in"),
        ({"fit_steps": 0}, "at least one step"),
        ({"fit_rate": 0.0}, "must be positive"),
    ],
)
def test_starts_that_cannot_be_are_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        StartSpec(**changes)


@pytest.mark.full
def test_large_videos_are_looked_at_smaller(monkeypatch):
    monkeypatch.setattr(record, "MOST_PIXELS", FRAMES * 96 * 72 // 3)
    capture = two_planes.make(**MOVES, frames=FRAMES)
    evidence = record.gather(capture)
    assert evidence.factor == 2
    assert evidence.moving.shape[1:] == (36, 48)
    effect = effect_of(MOTIONS["bases"])
    start = StartSpec(motion="tracks", moving_points=50, fit_steps=100)
    started = track_start.start(start, effect, evidence, capture, jax.random.key(0))
    assert (
        abs(np.median(started.position[:, 2]) - two_planes.NEAR) < 0.3
    )  # the wall: 0.7
