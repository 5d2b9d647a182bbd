"""Tracks of few frames: cameras that take turns, far from each other."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerfies_jax.preprocessing import (
    dense_flow,
    lost_regions,
    paths,
    rigid_bodies,
    short_tracks,
    tracks,
    view_set,
)
from nerfies_jax.preprocessing.tracks import Tracks
from nerfies_jax.preprocessing.view_set import Views
from tests.preprocessing import two_planes

FRAMES, POINTS, FOCAL = 24, 500, 200.0
SPAN = (0.4, 1.5)


def rig(step=0.15, rise=0.05) -> Views:
    """Cameras on an arc in two rows, which look at the origin."""
    frame = np.arange(FRAMES)
    angle = step * (11 - np.abs(11 - frame % 22) - 5.5)
    height = np.where(frame % 2, rise, 0.0)
    position = np.stack([np.sin(angle), height, np.cos(angle)], -1) * [0.66, 1, 0.66]
    ahead = -position / np.linalg.norm(position, axis=1, keepdims=True)
    right = np.cross(ahead, [0, 1, 0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    matrix = np.array([[FOCAL, 0, 88], [0, FOCAL, 66], [0, 0, 1.0]])
    empty = np.zeros((FRAMES, 132, 176), np.float32)
    return Views(
        row=frame,
        camera=frame,
        time=np.linspace(0, 1, FRAMES),
        image=np.zeros((*empty.shape, 3), np.uint8),
        gray=empty,
        valid=empty == 0,
        textured=empty == 0,
        intrinsics=np.tile(matrix, (FRAMES, 1, 1)),
        rotation=rotation,
        position=position,
    )


def rolling_ball(views):
    """Return tracks of 3 to 6 frames on a rotating ball, and the true positions."""
    rng, time = np.random.default_rng(0), views.time[:, None]
    normal = rng.normal(size=(POINTS, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turn = Rotation.from_rotvec(3 * np.pi * time * [0.2, 1.0, 0.1]).as_matrix()
    turned = np.einsum("fij,nj->nfi", turn, normal)
    swing = [0.12, 0.04, 0.05] * np.sin(2 * np.pi * (time * [2, 3, 2] + [0, 0.3, 0.1]))
    world = 0.085 * turned + swing
    to_camera = views.position - world
    seen = np.einsum("nfi,nfi->nf", turned, to_camera) > 0.02
    pixel = np.zeros((*world.shape[:2], 2), np.float32)
    for frame in range(FRAMES):
        pixel[:, frame], _ = view_set.project(views, frame, world[:, frame])
    pixel += rng.normal(0, 0.2, pixel.shape)
    first = rng.integers(0, FRAMES - 3, POINTS)
    frame = np.arange(FRAMES)
    length = rng.integers(3, 7, (POINTS, 1))
    within = (frame >= first[:, None]) & (frame < first[:, None] + length)
    survives = (seen | ~within).all(1)
    return Tracks(first, pixel, within).take(survives), world[survives]


def depth_ratios(views, fitted, world):
    ratio = fitted.depth / views.depth_of(world)
    return ratio[fitted.known]


@pytest.mark.full
def test_a_body_of_short_tracks_is_placed_by_its_smooth_motion():
    views = rig()
    moving, world = rolling_ball(views)
    alone = paths.least_acceleration(views, moving, 0.01)
    assert np.quantile(depth_ratios(views, alone, world), 0.25) < 0.75
    fitted = rigid_bodies.refined_short(views, moving, alone, 3)
    ratio = depth_ratios(views, fitted, world)
    assert len(ratio) > 0.7 * moving.visible.sum()
    assert np.abs(np.median(ratio) - 1) < 0.2
    assert np.quantile(np.abs(ratio / np.median(ratio) - 1), 0.8) < 0.2
    on_body = fitted.known.any(1)
    assert (fitted.depth_deviation[on_body] < rigid_bodies.MOST_DEVIATION).all()


def test_tracks_without_a_body_are_known_if_they_are_long():
    views = rig()
    moving, _ = rolling_ball(views)
    few = moving.take(np.arange(12))
    alone = paths.least_acceleration(views, few, 0.01)
    fitted = rigid_bodies.refined_short(views, few, alone, 3)
    long = alone.known.sum(1) >= rigid_bodies.LEAST_KNOWN
    np.testing.assert_array_equal(fitted.known, alone.known & long[:, None])


def test_short_tracks_are_for_cameras_far_apart_with_flow_between_them():
    assert short_tracks.lengths(rig(), SPAN, 0.8) == short_tracks.SHORT
    shuffled = short_tracks.lengths(rig(), SPAN, 0.6)
    assert shuffled == short_tracks.USUAL
    near = rig(step=0.02, rise=0.0)
    assert short_tracks.lengths(near, SPAN, 1.0) == short_tracks.USUAL
    turning = near._replace(position=np.zeros((FRAMES, 3)))
    assert short_tracks.lengths(turning, SPAN, 1.0) == short_tracks.USUAL


def test_a_region_that_jumps_is_found_again():
    # The card jumps by 20 px, nearly its width, and the wall moves by 4 px.
    capture = two_planes.make(
        frames=3,
        camera=lambda time: (0.18 * time, 0.0, 0.0),
        card=lambda time: (0.6 * time - 0.25, 0.04 * np.sin(9 * time)),
    )
    views = view_set.in_time_order(capture)
    images = dense_flow.leveled(views)
    span = view_set.depth_span(capture, views)
    flow = dense_flow.between_neighbors(views, images, span)
    recovered = lost_regions.recovered(
        views, images, flow, lost_regions.pairs(views, flow)
    )

    def right(flow, on_card):
        shares = []
        for frame in range(2):
            time = views.time[frame : frame + 2]
            card = np.diff([(0.6 * t, 0.04 * np.sin(9 * t)) for t in time], axis=0)[0]
            depth = two_planes.NEAR if on_card else two_planes.FAR
            step = np.diff(views.position[frame : frame + 2, :2], axis=0)[0]
            true = two_planes.FOCAL * (on_card * card - step) / depth
            pixels = capture.moving[frame] == on_card
            pixels &= flow.forward_valid[frame]
            error = np.linalg.norm(flow.forward[frame] - true, axis=-1)
            shares.append((error[pixels] < 1).sum() / capture.moving[frame].sum())
        return np.array(shares)

    assert (right(flow, on_card=True) < 0.2).all()
    assert (right(recovered, on_card=True) > 0.45).all()
    wall = right(recovered, on_card=False)
    assert (wall > 0.95 * right(flow, on_card=False)).all()


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_starts_on_a_mask_lie_on_it(share):
    mask = np.zeros((4, 30, 58), bool)
    mask[1, 10:20, 20:40] = share > 0
    starts = tracks.grid_on(mask)
    frame, column, row = starts.astype(int).T
    assert mask[frame, row, column].all()
    assert len(starts) == share * 200


def test_starts_on_a_mask_are_fewer_in_long_videos(monkeypatch):
    monkeypatch.setattr(tracks, "MOST_PLACES", 200)
    starts = tracks.grid_on(np.ones((4, 30, 58), bool), every=2)
    assert len(starts) == 50
    assert set(starts[:, 0]) == {0, 2}
