"""Where the camera goes in a video."""

import dataclasses

import numpy as np
import pytest
import scipy.spatial.transform

from nerfies_jax.capture import camera_paths, keyframes
from nerfies_jax.capture.keyframes import Keyframe
from nerfies_jax.geometry import camera as cameras
from tests import scenes


def rig(target, count=8):
    """Cameras on an arc, all looking at one target."""
    angle = np.linspace(-0.5, 0.5, count)
    places = target + 2.0 * np.stack(
        [np.sin(angle), 0.2 * np.cos(3 * angle), np.cos(angle)], axis=-1
    )
    return cameras.stack(
        [cameras.look_at(p, target, (0.0, 1.0, 0.0), 40.0, (40, 30)) for p in places]
    )


def test_the_focus_is_where_all_axes_meet():
    target = np.array([0.3, -0.1, 0.2])
    focus = camera_paths.focus_point(rig(target), 0.5, 10.0)
    np.testing.assert_allclose(focus, target, atol=1e-5)


def test_parallel_axes_focus_halfway_in_inverse_depth():
    one = cameras.look_at((0, 0, 0), (0, 0, 1), (0, 1, 0), 40.0, (40, 30))
    row = cameras.stack(
        [one._replace(position=np.float32([x, 0, 0])) for x in (-1.0, 0.0, 1.0)]
    )
    focus = camera_paths.focus_point(row, 1.0, 4.0)
    np.testing.assert_allclose(focus, [0, 0, 1.6], atol=1e-6)


def test_axes_that_meet_behind_the_cameras_are_not_believed():
    away = rig(np.zeros(3))
    flipped = away._replace(
        camera_from_world=away.camera_from_world
        * np.float32([[-1], [1], [-1]])  # turned around: the axes meet behind
    )
    focus = camera_paths.focus_point(flipped, 0.5, 2.0)
    offset = focus - flipped.position.mean(axis=0)
    assert offset @ flipped.camera_from_world[:, 2, :].mean(axis=0) > 0


@pytest.mark.parametrize("kind", camera_paths.KINDS)
def test_every_path_looks_at_the_scene_with_proper_rotations(kind):
    capture = scenes.tiny_capture()
    path = camera_paths.path(kind, capture, 5)
    assert path.position.shape == (5, 3)
    cameras.validate(path, capture.size)
    if kind != "captured":
        poses = cameras.take(capture.cameras, capture.train)
        target = camera_paths.focus_point(poses, capture.near, capture.far)
        offset = target - path.position
        ahead = np.einsum("ni,ni->n", offset, path.camera_from_world[:, 2, :])
        np.testing.assert_allclose(ahead, np.linalg.norm(offset, axis=1), rtol=1e-4)


@pytest.mark.parametrize("tilt", [0.0, 1e-7, 0.1])
@pytest.mark.parametrize("kind", ["sway", "orbit", "lemniscate"])
def test_a_camera_overhead_keeps_what_its_images_call_up(kind, tilt):
    """What is up lies along the view: no image may be undefined, or turn over."""
    place = np.array([0.0, -2 * np.sin(tilt), 2 * np.cos(tilt)])
    one = cameras.look_at(place, np.zeros(3), (0.0, 1.0, 0.0), 40.0, (40, 30))
    poses = cameras.stack([one] * 10)
    capture = scenes.tiny_capture()
    capture = dataclasses.replace(
        capture,
        cameras=cameras.take(poses, np.zeros(len(capture.ids), int)),
        up=(0.0, 0.0, 1.0),
    )
    path = camera_paths.path(kind, capture, 9)
    cameras.validate(path, capture.size)
    if kind != "orbit":
        upward = path.camera_from_world[:, 1] @ one.camera_from_world[1]
        assert upward.min() > 0.9


def test_sway_stays_within_the_span_of_the_capture():
    capture = scenes.tiny_capture()
    places = capture.cameras.position[capture.train]
    swaying = camera_paths.path("sway", capture, 16).position
    reach = np.abs(places - np.median(places, axis=0)).max() + 0.05
    assert np.abs(swaying - np.median(places, axis=0)).max() < reach


def test_a_single_camera_position_still_sways_a_little():
    capture = scenes.tiny_capture()
    still = np.broadcast_to(capture.cameras.position[:1], (len(capture.ids), 3)).copy()
    capture = dataclasses.replace(
        capture, cameras=capture.cameras._replace(position=still)
    )
    assert np.ptp(camera_paths.path("sway", capture, 8).position, axis=0).max() > 1e-3


def test_times_play_forwards_and_back():
    times = camera_paths.times(8)
    np.testing.assert_allclose(times, [0, 0.25, 0.5, 0.75, 1, 0.75, 0.5, 0.25])
    quarter = camera_paths.times(8, loops=0.25)
    assert quarter.max() < 0.5
    assert (np.diff(quarter) > 0).all()


def test_a_stabilized_path_keeps_a_walk_and_loses_its_shake():
    rng, times = np.random.default_rng(0), np.linspace(0, 1, 120)
    angle = 0.8 * times - 0.4  # a steady turn about a vertical axis, and a steady walk
    walk = np.stack([2 * times, 0.1 * times, -3 + 0.5 * times], axis=1)
    shake = scipy.spatial.transform.Rotation.from_rotvec(
        rng.normal(scale=0.02, size=(120, 3))
    )
    turn = scipy.spatial.transform.Rotation.from_rotvec(
        np.stack([0 * angle, angle, 0 * angle], axis=1)
    )
    shaky = cameras.stack(
        [
            cameras.pinhole(rotation, place, 40.0, (40, 30))
            for rotation, place in zip(
                (shake * turn).as_matrix(),
                walk + rng.normal(scale=0.03, size=(120, 3)),
                strict=True,
            )
        ]
    )
    path = camera_paths.smoothed(shaky, times, times)
    cameras.validate(path, (40, 30))
    # Ends included: a mean of what is around them would cut the walk short there.
    off = np.linalg.norm(path.position - walk, axis=1)
    assert off.max() < 0.04  # 0.03 a coordinate before; some 12 frames are weighed
    assert off.mean() < 0.02
    smooth = scipy.spatial.transform.Rotation.from_matrix(path.camera_from_world)
    assert (smooth * turn.inv()).magnitude().mean() < 0.012
    steps = np.linalg.norm(np.diff(path.position, n=2, axis=0), axis=1)
    shaken = np.linalg.norm(np.diff(shaky.position, n=2, axis=0), axis=1)
    assert steps.mean() < 0.05 * shaken.mean()


def test_a_path_along_the_capture_is_there_when_the_capture_was():
    capture = scenes.tiny_capture()
    times = np.sort(capture.times[capture.train])
    captured = camera_paths.planned("captured", capture, len(times))
    np.testing.assert_array_equal(captured.times, times)
    stabilized = camera_paths.planned("stabilized", capture, 7).times
    np.testing.assert_allclose(stabilized, np.linspace(times[0], times[-1], 7), 1e-6)
    assert camera_paths.planned("sway", capture, 7).times is None


def test_a_lemniscate_meets_its_middle_twice_and_stays_in_the_span_of_the_sway():
    capture = scenes.tiny_capture()
    around, eight = (
        camera_paths.path(kind, capture, 16).position for kind in ("sway", "lemniscate")
    )
    middle = np.median(capture.cameras.position[capture.train], axis=0)
    np.testing.assert_allclose(eight[[0, 8]], [middle, middle], atol=1e-6)
    reach = np.linalg.norm(around - middle, axis=1).max()
    assert np.linalg.norm(eight - middle, axis=1).max() < 1.5 * reach
    # Mirrored in its middle, which an ellipse is at other phases.
    np.testing.assert_allclose(eight[2] + eight[14], 2 * middle, atol=1e-6)


def test_an_unknown_path_is_refused():
    with pytest.raises(ValueError, match="no camera path 'spiral'; there are sway"):
        camera_paths.path("spiral", scenes.tiny_capture(), 3)


def test_a_path_passes_its_keyframes_and_overshoots_nothing():
    chosen = cameras.take(rig(np.zeros(3)), [0, 3, 4, 7])
    times = [0.0, 0.8, 0.8, 0.2]
    frames = [
        Keyframe(cameras.take(chosen, row), time) for row, time in enumerate(times)
    ]
    path = keyframes.through(frames, (40, 30), 31)
    at = [0, 10, 20, 30]
    np.testing.assert_allclose(path.cameras.position[at], chosen.position, atol=1e-6)
    np.testing.assert_allclose(
        path.cameras.camera_from_world[at], chosen.camera_from_world, atol=1e-6
    )
    np.testing.assert_allclose(path.times[at], times, atol=1e-7)
    # A plain cubic spline goes to 0.9 between the two keyframes at 0.8.
    assert path.times.max() <= np.float32(0.8) + 1e-6
    assert (np.diff(path.times[:11]) > 0).all()
    cameras.validate(path.cameras, path.size)
    with pytest.raises(ValueError, match=r"1 keyframe\(s\); a camera path needs"):
        keyframes.through(frames[:1], (40, 30), 31)
    with pytest.raises(ValueError, match="expected 4 to"):
        keyframes.through(frames, (40, 30), 3)
