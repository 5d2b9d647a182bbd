"""Where the camera goes in a film."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax.capture import camera_paths
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


def test_up_is_the_mean_of_the_pictures_up():
    np.testing.assert_allclose(camera_paths.mean_up(rig(np.zeros(3)))[1], 1, atol=0.05)


@pytest.mark.parametrize("kind", camera_paths.KINDS)
def test_every_path_looks_at_the_scene_with_proper_rotations(kind):
    capture = scenes.tiny_capture()
    path = camera_paths.path(kind, capture, 5)
    assert path.position.shape == (5, 3)
    cameras.validate(path, capture.size)
    if kind != "captured":
        filmed = cameras.take(capture.cameras, capture.train)
        target = camera_paths.focus_point(filmed, capture.near, capture.far)
        offset = target - path.position
        ahead = np.einsum("ni,ni->n", offset, path.camera_from_world[:, 2, :])
        np.testing.assert_allclose(ahead, np.linalg.norm(offset, axis=1), rtol=1e-4)


def test_sway_stays_within_the_filmed_span():
    capture = scenes.tiny_capture()
    filmed = capture.cameras.position[capture.train]
    swaying = camera_paths.path("sway", capture, 16).position
    reach = np.abs(filmed - np.median(filmed, axis=0)).max() + 0.05
    assert np.abs(swaying - np.median(filmed, axis=0)).max() < reach


def test_a_single_filming_position_still_sways_a_little():
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
