"""Rigid things placed by their own size in the images."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerfies_jax.preprocessing import bundle, rigid_bodies, view_set
from nerfies_jax.preprocessing.paths import Paths
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.view_set import Views

FRAMES, POINTS, FOCAL, SIZE = 40, 60, 200.0, (176, 132)


def views(sway=0.25) -> Views:
    """Cameras along a shaken line that all look along +z."""
    time = np.linspace(0, 1, FRAMES)
    rng = np.random.default_rng(0)
    shake = np.cumsum(rng.normal(0, 0.01, (FRAMES, 3)), axis=0)
    position = shake + np.stack([sway * (time - 0.5), 0 * time, 0 * time], -1)
    blank = np.zeros((FRAMES, SIZE[1], SIZE[0]), np.float32)
    width, height = SIZE
    matrix = np.array([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1.0]])
    return Views(
        row=np.arange(FRAMES),
        camera=np.zeros(FRAMES, int),
        time=time,
        image=np.zeros((*blank.shape, 3), np.uint8),
        gray=blank,
        valid=blank == 0,
        textured=blank == 0,
        intrinsics=np.tile(matrix, (FRAMES, 1, 1)),
        rotation=np.tile(np.eye(3), (FRAMES, 1, 1)),
        position=position,
    )


def turning_body(seed=1):
    """[points, frames, 3] of a thing that turns and swings faster than the camera."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, FRAMES)
    point = rng.uniform(-0.1, 0.1, (POINTS, 3))
    turn = Rotation.from_rotvec(time[:, None] * [0.4, 2.5, 0.3]).as_matrix()
    swing = 0.06 * np.sin(2 * np.pi * (2 * time[:, None] + [0, 0.3, 0.6]))
    return np.einsum("fij,nj->nfi", turn, point) + swing + [0, 0, 1.2]


def tracks_of(seen_from: Views, world, noise_px=0.15, seed=2) -> Tracks:
    """Each for twelve frames or more, not all from the start."""
    rng = np.random.default_rng(seed)
    pixel = np.zeros((*world.shape[:2], 2), np.float32)
    for frame in range(FRAMES):
        pixel[:, frame], _ = view_set.project(seen_from, frame, world[:, frame])
    pixel += rng.normal(0, noise_px, pixel.shape)
    first = rng.integers(0, FRAMES - 12, len(world))
    last = np.minimum(first + rng.integers(12, 25, len(world)), FRAMES)
    frame = np.arange(FRAMES)
    return Tracks(first, pixel, (frame >= first[:, None]) & (frame < last[:, None]))


def first_paths(seen_from, tracks, world):
    """Along the right rays, too far in some frames and too near in others."""
    frame = np.arange(FRAMES)
    factor = 1 + 0.08 * np.sin(2 * np.pi * frame / FRAMES)
    offset = factor[:, None] * (world - seen_from.position)
    position = np.where(tracks.visible[..., None], seen_from.position + offset, np.nan)
    deviation = np.full(len(world), 0.08)
    return Paths(position, tracks.visible, offset[..., 2], deviation, deviation < 0)


@pytest.fixture(autouse=True)
def two_groups(monkeypatch):
    monkeypatch.setattr(rigid_bodies, "GROUPS", 2)  # not twelve: there are few tracks


def test_a_thing_that_swings_faster_than_the_camera_is_placed_by_its_own_size():
    seen_from, world = views(), turning_body()
    tracks = tracks_of(seen_from, world)
    alone = first_paths(seen_from, tracks, world)
    refined = rigid_bodies.refined(seen_from, tracks, alone)
    assert refined.known.sum() > 0.9 * alone.known.sum()
    # What is left is one factor of all distances to the camera.
    true = world[..., 2] - seen_from.position[:, 2]
    spread = [np.std((each.depth / true)[each.known]) for each in (alone, refined)]
    assert spread[1] < 0.01 < 0.05 < spread[0], spread
    assert abs(np.median((refined.depth / true)[refined.known]) - 1) < 0.05
    depth = refined.position[..., 2] - seen_from.position[:, 2]
    np.testing.assert_allclose(refined.depth[refined.known], depth[refined.known])
    hasty = rigid_bodies.refined(seen_from, tracks, alone, lambda terms: False)
    np.testing.assert_array_equal(hasty.position, alone.position)


def test_a_body_grows_to_a_side_that_shares_three_frames_with_the_others():
    seen_from, world = views(), turning_body()
    tracks = tracks_of(seen_from, world, noise_px=0.05)
    frame, is_early = np.arange(FRAMES), np.arange(POINTS)[:, None] < POINTS // 2
    visible = np.where(is_early, frame < 14, frame >= 11)
    tracks = Tracks(np.where(is_early, 0, 11)[:, 0], tracks.pixel, visible)
    alone = first_paths(seen_from, tracks, world)
    refined = rigid_bodies.refined(seen_from, tracks, alone)
    assert refined.is_rigid.mean() > 0.9
    # Adjusted alone, the sides would differ by the mean error of their paths, 8 %.
    ratio = refined.depth / (world[..., 2] - seen_from.position[:, 2])
    early, late = (
        np.median(ratio[side & refined.known]) for side in (is_early, ~is_early)
    )
    assert abs(early / late - 1) < 0.02


@pytest.mark.full
def test_of_a_long_video_a_thing_is_adjusted_in_some_frames_and_posed_in_all(
    monkeypatch,
):
    seen_from, world = views(), turning_body()
    tracks = tracks_of(seen_from, world)
    alone = first_paths(seen_from, tracks, world)
    whole = rigid_bodies.refined(seen_from, tracks, alone)
    monkeypatch.setattr(rigid_bodies, "MOST_FRAMES", FRAMES // 2)  # every second
    some = rigid_bodies.refined(seen_from, tracks, alone)
    assert some.known.sum() > 0.9 * whole.known.sum()
    true = world[..., 2] - seen_from.position[:, 2]
    assert np.std((some.depth / true)[some.known]) < 0.01


@pytest.mark.full
def test_what_bends_keeps_its_own_paths():
    seen_from, world = views(), turning_body()
    time = np.linspace(0, 1, FRAMES)
    phase = np.random.default_rng(3).uniform(0, 1, (POINTS, 1, 3))
    world = world + 0.05 * np.sin(2 * np.pi * (4 * time[:, None] + phase))
    tracks = tracks_of(seen_from, world)
    alone = first_paths(seen_from, tracks, world)
    refined = rigid_bodies.refined(seen_from, tracks, alone)
    np.testing.assert_array_equal(refined.known, alone.known)
    np.testing.assert_array_equal(refined.position, alone.position)


def sliding(monkeypatch):
    """A body that slides in step with a sweeping camera, and paths 4 % too far."""
    monkeypatch.setattr(rigid_bodies, "GROUPS", 1)
    monkeypatch.setattr(rigid_bodies, "LARGE_GROUPS", 1)
    monkeypatch.setitem(globals(), "FRAMES", 60)
    time = np.linspace(0, 1, FRAMES)
    sweep = 0.25 * np.sin(5 * np.pi * time)
    camera = np.stack([sweep, 0 * time, sweep**2], -1)
    seen_from = views()._replace(position=camera)
    rng = np.random.default_rng(0)
    point = rng.uniform(-0.1, 0.1, (POINTS, 1, 3))
    slide = 0.03 * np.cos(4 * np.pi * time)[:, None] * [1.0, 0, 0]
    world = point + slide + [0, 0, 1.2]
    tracks = tracks_of(seen_from, world, noise_px=0.05)
    tracks = Tracks(0 * tracks.start, tracks.pixel, np.ones_like(tracks.visible))
    offset = 1.04 * (world - camera)
    position = np.where(tracks.visible[..., None], camera + offset, np.nan)
    deviation = np.full(POINTS, 0.03)
    alone = Paths(position, tracks.visible, offset[..., 2], deviation, deviation < 0)
    true = world[..., 2] - camera[:, 2]
    return seen_from, tracks, alone, true


@pytest.mark.full
def test_a_precisely_rigid_body_has_the_scale_of_its_likely_motion(monkeypatch):
    seen_from, tracks, alone, true = sliding(monkeypatch)
    refined = rigid_bodies.refined(seen_from, tracks, alone)
    assert abs(np.median((refined.depth / true)[refined.known]) - 1) < 0.01
    assert refined.is_rigid.all()
    np.testing.assert_array_equal(refined.depth_deviation, alone.depth_deviation)
    # With coarse tracks and an uncertainty like that, a body may be a piece of cloth.
    pixel = np.random.default_rng(1).normal(tracks.pixel, 0.3)
    coarse = rigid_bodies.refined(seen_from, tracks._replace(pixel=pixel), alone)
    np.testing.assert_array_equal(coarse.position, alone.position)
    assert not coarse.is_rigid.any()


@pytest.mark.full
def test_a_body_that_no_rigid_motion_fits_well_is_scaled_as_a_whole(monkeypatch):
    seen_from, tracks, alone, true = sliding(monkeypatch)
    monkeypatch.setattr(rigid_bodies, "TRACK_PX", 0.0)  # no error is small enough
    alone = alone._replace(depth_deviation=np.full(POINTS, 0.1))
    refined = rigid_bodies.refined(seen_from, tracks, alone)
    ratio = (refined.depth / alone.depth)[alone.known]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
    assert abs(np.median((refined.depth / true)[alone.known]) - 1) < 0.02
    np.testing.assert_array_equal(refined.known, alone.known)


def test_few_paths_are_left_as_they_are():
    seen_from, world = views(), turning_body()[:5]
    tracks = tracks_of(seen_from, world)
    alone = first_paths(seen_from, tracks, world)
    assert rigid_bodies.refined(seen_from, tracks, alone) is alone


@pytest.mark.parametrize("flat", [False, pytest.param(True, marks=pytest.mark.full)])
def test_a_body_is_adjusted_to_what_was_seen_of_it(flat):
    seen_from, world = views(), turning_body()
    body = bundle.Body(world[:, 0] - world[:, 0].mean(0), *_motion(world))
    if flat:  # points on a plane say where it is as well
        body = body._replace(point=body.point * [1, 1, 0])
        world = body.world()
    tracks = tracks_of(seen_from, world, noise_px=0)
    known = tracks.visible.copy()
    known[:, 17] = False  # nothing of it is seen in one frame
    seen = bundle.sight(seen_from, tracks, known)
    rng = np.random.default_rng(4)
    off = body._replace(
        point=body.point + rng.normal(0, 0.01, body.point.shape),
        shift=body.shift + rng.normal(0, 0.01, body.shift.shape),
    )
    actual = bundle.adjusted(seen_from, seen, off)
    assert np.median(bundle.misses(seen_from, seen, actual)) < 0.02
    factor = np.median(world[known][:, 2] / actual.world()[known][:, 2])
    whole = bundle.scaled(seen_from, actual, factor)
    assert np.median(np.linalg.norm(whole.world() - world, axis=-1)[known]) < 2e-3
    assert np.isfinite(actual.world()).all()


def _motion(world):
    middle = world.mean(0)
    turn = [
        Rotation.align_vectors(now - c, world[:, 0] - middle[0])[0].as_matrix()
        for now, c in zip(np.moveaxis(world, 1, 0), middle, strict=True)
    ]
    return np.stack(turn), middle


def test_positions_far_from_the_start_of_a_track_count_less():
    """Patches slip in the end, which looks like a change of distance if all do."""
    seen_from, world = views(), turning_body()
    body = bundle.Body(world[:, 0] - world[:, 0].mean(0), *_motion(world))
    errors = []
    for seed in range(3):
        tracks = tracks_of(seen_from, world, noise_px=0.05, seed=seed)
        age = np.arange(FRAMES) - tracks.start[:, None]
        outward = tracks.pixel - tracks.pixel.mean(0)
        slipped = 1 + 0.02 * np.maximum(age / 4 - 1, 0)
        pixel = tracks.pixel + (slipped[..., None] - 1) * outward
        seen = bundle.sight(
            seen_from, tracks._replace(pixel=np.float32(pixel)), tracks.visible
        )
        np.testing.assert_allclose(seen.weight.mean(), 1)
        equal = seen._replace(weight=np.ones_like(seen.weight))
        for each in (seen, equal):
            depth = bundle.adjusted(seen_from, each, body).world()[..., 2]
            ratio = np.median(depth / world[..., 2], axis=0)
            errors.append(np.std(ratio / ratio.mean()))
    weighted, equal = np.mean(np.reshape(errors, (3, 2)), axis=0)
    assert weighted < 0.9 * equal, (weighted, equal)


def test_slopes_of_misses_are_differences():
    seen_from, world = views(), turning_body()
    body = bundle.Body(world[:, 0] - world[:, 0].mean(0), *_motion(world))
    seen = bundle.sight(
        seen_from, tracks_of(seen_from, world), np.ones((POINTS, FRAMES), bool)
    )
    _, slope, _ = bundle._reproject(seen_from, seen, body)
    for axis in range(3):
        step = 1e-5 * np.eye(3)[axis]
        ends = [
            bundle._reproject(seen_from, seen, body._replace(shift=body.shift + s))[0]
            for s in (step, -step)
        ]
        np.testing.assert_allclose(
            slope[..., axis], (ends[0] - ends[1]) / 2e-5, rtol=1e-4, atol=1e-4
        )


def test_tracks_that_are_nowhere_known_miss_by_any_distance():
    none = np.zeros((0, 2))
    nowhere = bundle.Sight(
        *np.zeros((2, 0), int), none, np.zeros((0, 2, 3)), none[:, 0]
    )
    miss = bundle.typical_misses(nowhere, np.zeros(0), 3)
    np.testing.assert_array_equal(miss, np.inf)
