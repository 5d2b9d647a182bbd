"""Flow, tracks, what moves, and paths in space, on captures of two planes."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
import scipy.ndimage as nd

from nerfies_jax.capture.capture import PointCloud
from nerfies_jax.preprocessing import (
    dense_flow,
    motion,
    moving,
    paths,
    photo_consistency,
    record,
    rest_points,
    still_points,
    tracks,
    view_set,
)
from nerfies_jax.preprocessing.dense_flow import NeighborFlow
from nerfies_jax.preprocessing.rest_points import RestPoints
from nerfies_jax.preprocessing.tracks import Tracks
from tests.preprocessing import two_planes


def shaking(t):
    return 0.3 * t - 0.15 + 0.03 * np.sin(25 * t), 0.04 * np.cos(19 * t), 0.0


MOVES = {"card": lambda time: (0.4 * time - 0.2, 0.1 * time), "camera": shaking}


@functools.cache
def gathered(**changes):
    capture = two_planes.make(**(changes or MOVES), frames=24)
    return capture, record.gather(capture)


def card_path(capture, rows):
    """[frames, 2] where the middle of the card is, scene units."""
    return np.array([MOVES["card"](time) for time in capture.times[rows]])


@functools.cache
def hand_held(frames=24):
    """Views of a camera that shakes, in scene units; images are of no matter."""
    capture = two_planes.make(camera=shaking, frames=frames, blank=True)
    return view_set.in_time_order(capture)


def tracks_of(views, position):
    """Exact tracks of points [points, frames, 3], seen everywhere."""
    pixel = np.stack(
        [
            view_set.project(views, frame, position[:, frame])[0]
            for frame in range(position.shape[1])
        ],
        axis=1,
    )
    start = np.zeros(len(position), int)
    return Tracks(start, pixel.astype(np.float32), np.ones(pixel.shape[:2], bool))


@pytest.mark.parametrize("light", [lambda time: 1.0, lambda time: 1 - 0.6 * time])
def test_flow_of_a_wall_is_that_of_its_homography_in_any_light(light):
    capture = two_planes.make(shown=lambda time: False, gain=light, frames=4)
    views = view_set.in_time_order(capture)
    flow = dense_flow.between_neighbors(views, dense_flow.leveled(views))
    ray = view_set.rays(views, 1)
    point = views.position[1] + two_planes.FAR * ray
    there, _ = view_set.project(views, 2, point.reshape(-1, 3))
    height, width = flow.forward.shape[1:3]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    true = there.reshape(height, width, 2) - np.stack([x, y], -1)
    inner = np.s_[8:-8, 12:-12]
    error = np.linalg.norm(flow.forward[1] - true, axis=-1)[inner]
    assert np.median(error) < 0.12
    assert flow.forward_seen[1][inner].mean() > 0.9
    assert not flow.forward_seen[-1].any()
    assert not flow.backward_seen[0].any()


def test_flow_that_does_not_lead_back_is_not_trusted():
    there = np.zeros((6, 8, 2), np.float32)
    back = there.copy()
    back[:, 4:] = 2
    closed = dense_flow.closed(there, back)
    np.testing.assert_array_equal(closed, np.arange(8)[None].repeat(6, 0) < 4)


def test_flow_that_a_thing_lost_is_found_from_how_it_came():
    capture = two_planes.make(shown=lambda time: False, frames=6)
    views = view_set.in_time_order(capture)
    images = dense_flow.leveled(views)
    true = dense_flow.between_neighbors(views, images)
    flow = NeighborFlow(*(part.copy() for part in true))
    area = np.s_[20:50, 30:70]
    for frame, shift, seen in ((2, *flow[:2]), (3, *flow[2:])):
        shift[frame][area], seen[frame][area] = 9.0, False
    assert dense_flow._lost(flow, 2)
    assert not dense_flow._lost(true, 2)
    search = dense_flow.dis(images.shape[2] // views.size[0])
    dense_flow._continue_motion(flow, 2, images, search)
    for frame, flow_of_frame, exact in (
        (2, flow[:2], true[:2]),
        (3, flow[2:], true[2:]),
    ):
        assert flow_of_frame[1][frame][area].mean() > 0.9
        off = np.abs(flow_of_frame[0][frame] - exact[0][frame])[area][
            flow_of_frame[1][frame][area]
        ]
        assert np.median(off) < 0.1
        unchanged = exact[1][frame].copy()
        unchanged[area] = False
        np.testing.assert_array_equal(
            flow_of_frame[0][frame][unchanged], exact[0][frame][unchanged]
        )


def test_chains_follow_flow_both_ways_until_it_ends():
    shape = (5, 20, 30)
    shift = np.tile(np.float32([1.25, -0.5]), (*shape, 1))
    seen = np.ones(shape, bool)
    seen[3] = False  # nothing leads from the fourth frame to the fifth
    flow = NeighborFlow(shift, seen, -shift, np.ones(shape, bool))
    chained = tracks.chain(flow, np.array([[2.0, 10.0, 12.0], [2.0, 29.0, 12.0]]))
    assert chained.visible[0].tolist() == [True] * 4 + [False]
    steps = np.arange(-2, 2)[:, None]
    expected = [10, 12] + steps * [1.25, -0.5]
    np.testing.assert_allclose(chained.pixel[0, :4], expected, atol=1e-5)
    # The other left the image on its right.
    assert chained.visible[1].tolist() == [True] * 3 + [False] * 2


def test_wide_steps_are_found_from_where_a_still_scene_would_be():
    # 18 px of 96 from frame to frame
    capture = two_planes.make(camera=lambda t: (1.2 * t - 0.6, 0.0, 0.0), frames=4)
    views = view_set.in_time_order(capture)
    images = dense_flow.leveled(views)
    height, width = views.gray.shape[1:]
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    shares = []
    for span in (None, view_set.depth_span(capture, views)):
        flow = dense_flow.between_neighbors(views, images, span)
        far_off = []
        for frame, depth in enumerate(capture.depths[:-1]):
            step = (views.position[frame] - views.position[frame + 1])[:2]
            true = two_planes.FOCAL * step / depth[..., None]
            at = np.stack([x, y], -1) + true
            inside = ((at > 3) & (at < np.array(views.size) - 4)).all(-1)
            error = np.linalg.norm(flow.forward[frame] - true, axis=-1)
            far_off.append(error[inside] > 1)
        shares.append(np.concatenate(far_off).mean())
    assert shares[0] > 0.5
    assert shares[1] < 0.05


def test_points_are_aligned_with_where_they_began():
    image = 255 * two_planes.texture(3).mean(-1)
    images = np.stack([nd.shift(image, (0.0, k))[:80, 20:140] for k in (0, 3.3)])
    images = np.rint(np.clip(images, 0, 255)).astype(np.uint8)
    pixel = np.float32([[[30, 40], [34, 40]], [[60, 20], [62.8, 20.3]]])
    drifted = Tracks(np.zeros(2, int), pixel, np.ones((2, 2), bool))
    aligned = tracks.realigned(drifted, images, (120, 80))
    assert aligned.visible.all()
    np.testing.assert_allclose(aligned.pixel[:, 1], [[33.3, 40], [63.3, 20]], atol=0.05)
    lost = drifted._replace(pixel=pixel + np.float32([[0, 0], [9, 9]]))
    assert not tracks.realigned(lost, images, (120, 80)).visible[:, 1].any()


def test_points_at_rest_are_found_and_what_moves_misses(monkeypatch):
    monkeypatch.setattr(rest_points, "AT_ONCE", 4)  # six tracks in two parts
    views = hand_held()
    rng = np.random.default_rng(0)
    point = rng.uniform([-0.3, -0.3, 1.2], [0.3, 0.3, 2], (6, 3))
    position = np.repeat(point[:, None], len(views.row), axis=1)
    position[3:] += np.linspace(0, 0.2, len(views.row))[:, None] * [0, 1, 0]
    fitted = rest_points.fit(views, tracks_of(views, position))
    np.testing.assert_allclose(fitted.position[:3], point[:3], atol=1e-4)
    assert np.nanmax(fitted.residual[:3]) < 0.01
    assert (np.nanquantile(fitted.residual[3:], 0.7, axis=1) > 1).all()


def test_a_camera_in_place_gives_finite_points_at_rest():
    capture = two_planes.make(camera=lambda t: (0.0, 0.0, 0.0), frames=6, blank=True)
    views = view_set.in_time_order(capture)
    position = np.repeat(np.array([[[0.1, 0.0, 1.5]]]), 6, axis=1)
    one = tracks_of(views, position)
    fitted = rest_points.fit(views, one)
    assert np.isfinite(fitted.position).all()
    assert still_points.depth_deviation(views, one, fitted) > 1


def test_what_moves_is_marked_and_little_else():
    capture, evidence = gathered()
    true = capture.moving[evidence.row]
    both = (evidence.moving & true).sum() / (evidence.moving | true).sum()
    assert both > 0.85  # 0.80 by the votes of tracks alone
    assert not evidence.unusable
    # Tracks on the wall beside the card, which flow drags along, are not among them.
    chosen = evidence.path_tracks
    row, column = tracks.pixel_of(chosen.pixel, true.shape[1:])
    on_card = true[np.arange(len(true)), row, column] & chosen.visible
    assert (on_card.sum(1) > 0.5 * chosen.visible.sum(1)).mean() > 0.97


@pytest.mark.parametrize("light", [lambda time: 1.0, lambda time: 1 - 0.6 * time])
def test_what_moves_looks_unlike_the_wall_behind_it_and_the_wall_like_itself(light):
    capture = two_planes.make(**MOVES, gain=light, frames=24)
    views = view_set.in_time_order(capture)
    odds = photo_consistency.log_odds(views, capture.points)
    inner = np.zeros_like(capture.moving)
    inner[:, 4:-4, 4:-4] = True
    card, wall = (
        nd.binary_erosion(part, np.ones((1, 3, 3))) & inner
        for part in (capture.moving, ~capture.moving)
    )
    assert (odds[card] > 0).mean() > 0.75  # the rest has the wall's color by chance
    assert (odds[wall] < 0).mean() > 0.98
    beside = wall & nd.binary_dilation(capture.moving, np.ones((1, 9, 9)))
    assert (odds[beside] < 0).mean() > 0.9  # next to the edge colors mix
    none = PointCloud(capture.points.position[:0], capture.points.color[:0])
    assert not photo_consistency.log_odds(views, none).any()


def test_smaller_views_show_the_same_points_in_larger_pixels():
    views = hand_held()
    point = np.random.default_rng(0).uniform([-0.3, -0.3, 1.2], [0.3, 0.3, 2], (5, 3))
    small = view_set.smaller(views, 3)
    assert small.size == (views.size[0] // 3, views.size[1] // 3)
    for frame in (0, 7):
        there, here = (view_set.project(one, frame, point)[0] for one in (views, small))
        np.testing.assert_allclose(3 * here, there, rtol=1e-9)
    means = [one.image[:, :72, :96].mean() for one in (views, small)]
    assert means[0] == pytest.approx(means[1], abs=1)


def test_nothing_moves_in_a_static_capture():
    _, evidence = gathered(card=lambda time: (0.1, 0.0))
    assert evidence.moving.mean() < 0.01
    assert len(evidence.paths.known) < 0.01 * len(evidence.score)


@pytest.mark.full
def test_cameras_that_are_off_by_a_pixel_set_no_wall_in_motion():
    capture = two_planes.make(**MOVES, frames=24)
    noise = np.random.default_rng(0).normal(
        0, 0.7 * two_planes.FAR / two_planes.FOCAL, (24, 3)
    )
    position = capture.cameras.position + (noise * [1, 1, 0]).astype(np.float32)
    cameras = capture.cameras._replace(position=position)
    evidence = record.gather(dataclasses.replace(capture, cameras=cameras))
    assert evidence.moving[~capture.moving].mean() < 0.1
    assert evidence.moving[capture.moving].mean() > 0.5


def test_moving_neighbors_convince_and_a_lonely_track_is_overruled():
    rng = np.random.default_rng(0)
    pixel = rng.uniform(0, 60, (300, 1, 2)).astype(np.float32)
    seen = np.ones((300, 6), bool)
    pixel = np.repeat(pixel, 6, axis=1)
    moves = pixel[:, 0, 0] < 20
    residual = np.where(moves, 3.0, 0.1)
    inside, outside = np.flatnonzero(moves)[0], np.flatnonzero(~moves)[0]
    pixel[inside], pixel[outside] = (8, 30), (50, 30)
    residual[inside], residual[outside] = 0.1, 3.0
    rest = RestPoints(np.zeros((300, 3)), np.repeat(residual[:, None], 6, 1), None)
    score = moving.track_scores(Tracks(np.zeros(300, int), pixel, seen), rest)
    assert score[inside] > 0.5 > score[outside]


def test_still_points_lie_on_the_wall_and_have_its_colors():
    capture, evidence = gathered()
    cloud = evidence.still
    assert len(cloud.position) > 2000
    depth = cloud.position[:, 2]
    assert abs(np.median(depth) - two_planes.FAR) < 0.01 * two_planes.FAR
    assert (abs(depth - two_planes.FAR) < 0.1 * two_planes.FAR).mean() > 0.95
    views = view_set.in_time_order(capture)
    pixel, _ = view_set.project(views, 12, cloud.position.astype(float))
    inside = ((pixel > 8) & (pixel < np.array(views.size) - 8)).all(-1)
    x, y = pixel[inside].astype(int).T
    still = ~capture.moving[evidence.row[12]][y, x]
    seen, other = (views.image[12][y, x + off].astype(float) for off in (0, 6))
    color = cloud.color[inside]
    off, by_chance = (abs(one - color)[still].mean() for one in (seen, other))
    assert off < 0.3 * by_chance


def test_a_smooth_path_before_a_shaking_camera_has_its_depth():
    views = hand_held()
    time = np.linspace(0, 1, len(views.row))[:, None]
    path = (0.1, -0.1, 1.3) + time * [0.2, 0.1, -0.2]
    fitted = paths.least_acceleration(views, tracks_of(views, path[None]), 0.05)
    assert np.linalg.norm(fitted.position[0] - path, axis=-1).max() < 0.01
    assert fitted.known.all()
    assert fitted.depth_deviation[0] < 0.05


@pytest.mark.parametrize("frames", [24, 120])
def test_a_video_of_more_frames_has_the_same_depths(frames):
    views = hand_held(frames)
    time = np.linspace(0, 1, frames)[:, None]
    turn = np.concatenate([np.sin(2 * time), np.cos(3 * time), 0 * time], -1)
    path = np.array([0.0, -0.1, 1.3]) + 0.05 * turn
    one = tracks_of(views, path[None])
    # Frame by frame a slow path hardly bends, and would lean on what stands around.
    fitted = paths.least_acceleration(views, one, 0.05, np.full((1, frames), 2.0))
    np.testing.assert_allclose(fitted.depth[0], 1.3, rtol=0.1)


def test_the_banded_solution_is_the_dense_one():
    views = hand_held()
    rng = np.random.default_rng(1)
    path = np.cumsum(rng.normal(0, 0.01, (24, 3)), axis=0) + np.array([0, 0, 1.4])
    one = tracks_of(views, path[None])
    one.visible[0, [0, 1, 9, 10]] = False
    around = np.full((1, 24), 1.5)
    fitted = paths.least_acceleration(views, one, 0.05, around)
    span = slice(2, 24)
    ray = rest_points.track_rays(views, one)[0, span]
    unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    noise = paths.TRACK_PX / views.intrinsics[0, 0, 0]
    pull = (noise / paths.AROUND_DEVIATION) ** 2
    rows, right = [], []
    for frame, (along, seen) in enumerate(zip(unit, one.visible[0, span], strict=True)):
        if not seen:
            continue
        basis = np.zeros((3, 22, 3))
        basis[:, frame] = np.eye(3) - np.outer(along, along)
        rows.append(basis.reshape(3, -1))
        right.append(basis[:, frame] @ views.position[2 + frame])
        basis = np.zeros((22, 3))
        basis[frame] = np.sqrt(pull) * along
        rows.append(basis.reshape(1, -1))
        there = views.position[2 + frame] + 1.5 * ray[frame]
        right.append(np.sqrt(pull) * (along @ there)[None])
    for frame in range(20):
        basis = np.zeros((3, 22, 3))
        for at, factor in ((0, 1), (1, -2), (2, 1)):
            basis[:, frame + at] = np.sqrt(paths.LEAST_PENALTY) * factor * np.eye(3)
        rows.append(basis.reshape(3, -1))
        right.append(np.zeros(3))
    dense = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    np.testing.assert_allclose(
        fitted.position[0, span], dense.reshape(22, 3), atol=1e-6
    )
    assert np.isnan(fitted.position[0, :2]).all()
    assert not fitted.known[0, :2].any()


@pytest.mark.hard_cases
@pytest.mark.parametrize("seen", [[7], [7, 8], [0, 23]], ids=["one", "two", "the ends"])
def test_a_path_of_few_frames_lies_at_the_depth_around(seen):
    views = hand_held()
    path = np.repeat(np.array([[[0.1, 0.0, 1.3]]]), 24, axis=1)
    one = tracks_of(views, path)
    one.visible[0] = np.isin(np.arange(24), seen)
    fitted = paths.least_acceleration(views, one, 0.05, np.full((1, 24), 1.3))
    np.testing.assert_allclose(fitted.depth[0, seen], 1.3, rtol=0.02)


@pytest.mark.hard_cases
def test_before_a_camera_in_place_depth_is_that_around_and_said_to_be_unknown():
    capture = two_planes.make(camera=lambda t: (0.0, 0.0, 0.0), frames=12, blank=True)
    views = view_set.in_time_order(capture)
    path = np.array([0, 0, 1.5]) + np.linspace(0, 0.3, 12)[:, None] * [1, 0, 0]
    one = tracks_of(views, path[None])
    fitted = paths.least_acceleration(views, one, 0.05, np.full((1, 12), 1.5))
    np.testing.assert_allclose(fitted.depth[0], 1.5, rtol=0.05)
    assert fitted.depth_deviation[0] > 1
    alone = paths.least_acceleration(views, one, 0.05)
    assert np.isfinite(alone.position).all()


def test_the_card_is_where_it_is():
    capture, evidence = gathered()
    true = card_path(capture, evidence.row)
    middle = np.nanmedian(
        np.where(evidence.paths.known[..., None], evidence.paths.position, np.nan), 0
    )
    inner = slice(4, -4)
    assert np.abs(middle[inner, 2] - two_planes.NEAR).max() < 0.1 * two_planes.NEAR
    assert np.abs(middle[inner, :2] - true[inner]).max() < 0.06
    speed = motion.speeds(view_set.in_time_order(capture), evidence)
    step = np.median(np.linalg.norm(np.diff(true, axis=0), axis=1))
    assert speed["speed_units"] == pytest.approx(step, rel=0.1)
    assert speed["speed_px"] == pytest.approx(
        step / two_planes.NEAR * two_planes.FOCAL, rel=0.1
    )


def test_masks_alone_are_those_of_the_whole_preprocessing(tmp_path):
    capture, whole = gathered()
    masks = record.gather(capture, masks_only=True)
    for name in ("row", "moving", "score", "flow", "tracks"):
        jax.tree.map(
            np.testing.assert_array_equal, getattr(masks, name), getattr(whole, name)
        )
    assert len(whole.path_tracks.visible)
    assert not len(masks.path_tracks.visible)
    assert not len(masks.still.position)
    # A record without paths is never read in place of a whole one.
    files = {
        record.file_of(capture, tmp_path, masks_only=only) for only in (False, True)
    }
    assert len(files) == 2


@pytest.mark.full
def test_what_moves_before_the_near_plane_of_the_wall_is_known():
    """Structure from motion gives the plane, and no point of what moves."""
    near = 0.8 * two_planes.FAR
    assert near > two_planes.NEAR
    evidence = record.gather(two_planes.make(**MOVES, frames=12, near=near))
    assert len(evidence.paths.known) > 20
    seen = evidence.path_tracks.visible
    assert (evidence.paths.known & seen).sum() > 0.9 * seen.sum()


@pytest.mark.parametrize("coarse", [1.0, 1.5])
def test_detail_everywhere_is_texture_and_no_noise(coarse, rng):
    """As a lawn's; noise of as many levels is of single pixels and has no slopes."""
    gray = nd.gaussian_filter(rng.normal(size=(90, 120)), coarse)
    gray = np.float32(0.5 + 0.15 * gray / gray.std())
    assert view_set._textured(gray).mean() > 0.5
    plain = np.float32(0.5 + 4 / 255 * rng.normal(size=(90, 120)))
    assert view_set._textured(plain).mean() < 0.05


def test_a_long_video_has_no_more_places_than_memory_holds(monkeypatch):
    views = view_set.in_time_order(two_planes.make(frames=24))
    every = tracks.grid(views)
    places = len(every) * len(views.row)
    monkeypatch.setattr(tracks, "MOST_PLACES", places // 2)
    fewer = tracks.grid(views)
    assert 0 < len(fewer) * len(views.row) <= places // 2


def test_what_was_gathered_is_read_again(tmp_path):
    capture, evidence = gathered()
    path = tmp_path / "kept.npz"
    record.save(path, evidence)
    again = record.load(path)
    np.testing.assert_array_equal(again.moving, evidence.moving)
    np.testing.assert_array_equal(again.paths.position, evidence.paths.position)
    np.testing.assert_allclose(again.flow.forward, evidence.flow.forward, atol=2e-3)
    assert again.unusable == evidence.unusable
    assert record.digest(capture) == record.digest(two_planes.make(**MOVES, frames=24))
    assert record.digest(capture) != record.digest(two_planes.make(frames=24))
    # The span of depths, which steers the search for flow, is of these as well.
    assert record.digest(capture) != record.digest(
        dataclasses.replace(capture, far=2 * capture.far)
    )
    some = PointCloud(np.ones((3, 3), np.float32), np.ones((3, 3), np.uint8))
    assert record.digest(capture) != record.digest(
        dataclasses.replace(capture, points=some)
    )


def test_jumping_views_and_short_videos_say_why_they_are_of_no_use():
    jumps = two_planes.make(
        card=MOVES["card"], camera=lambda t: (3 * np.sin(400 * t), 0.0, 0.0), frames=12
    )
    assert "the camera motion is discontinuous" in record.gather(jumps).unusable
    assert "too few" in record.gather(two_planes.make(**MOVES, frames=4)).unusable
