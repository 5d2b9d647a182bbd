"""Points picked from an image and followed, in closed form."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax.evaluation import surface_tracks
from nerfies_jax.evaluation.model_flow import Moved
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training.model import Rendering, TrainState
from tests import scenes

DEPTH, SPEED = 2.0, 0.6  # scene units, and scene units over the whole time


@pytest.fixture(scope="module")
def capture():
    """The tiny capture, recorded from one place."""
    tiny = scenes.tiny_capture()
    rows = np.zeros(len(tiny.ids), int)
    return dataclasses.replace(tiny, cameras=cameras.take(tiny.cameras, rows))


def state_of(late):
    """A state that says from when on something stands before the wall."""
    return TrainState((), (), (), late, None)


def render(state, view):
    """A wall; late, something stands before the left half of it."""
    width, height = scenes.TINY_SCENE.size
    depth = np.full((height, width), DEPTH, np.float32)
    if float(view.time) > state.step:
        depth[:, : width // 2] = DEPTH / 2
    alpha = np.ones_like(depth)
    alpha[:5] = 0.4  # no surface to pick, nor to be seen on
    return Rendering(np.zeros((height, width, 3), np.float32), alpha, depth)


def moved(state, points, here, there):
    """All go right, as the camera sees it; the first is lost but at the start."""
    way = SPEED * (float(there.time) - float(here.time))
    places = points + way * np.asarray(here.camera.camera_from_world)[0]
    known = np.ones(len(points), bool)
    known[0] = way == 0
    return Moved(np.where(known[:, None], places, points), known)


def test_points_are_followed_until_they_leave_or_are_hidden(capture):
    late = 0.5
    tracks = surface_tracks.follow(moved, render, state_of(late), capture, 40, time=0.3)
    times = np.sort(capture.times[capture.train])
    np.testing.assert_array_equal(tracks.times, times)
    start = np.argmin(np.abs(times - 0.3))
    pixels = tracks.pixels[:, start]
    np.testing.assert_allclose(pixels % 1, 0.5, atol=1e-4)  # centers of pixels
    assert (pixels[:, 1] > 5).all()
    one = cameras.take(capture.cameras, 0)
    depth = (tracks.positions - one.position) @ one.camera_from_world[2]
    np.testing.assert_allclose(depth, DEPTH, rtol=1e-5)
    way = SPEED * (times - times[start])
    right = (tracks.positions - tracks.positions[:, [start]]) @ one.camera_from_world[0]
    np.testing.assert_allclose(right[1:], np.tile(way, (39, 1)), atol=1e-5)
    np.testing.assert_allclose(right[0], 0, atol=1e-6)
    # Where it went in the image, and what is drawn there
    across = pixels[:, :1] + float(one.focal_px) * way / DEPTH
    np.testing.assert_allclose(tracks.pixels[1:, :, 0], across[1:], atol=1e-3)
    inside = (across >= 0) & (across < capture.size[0])
    hidden = (times > late) & (across < capture.size[0] // 2)
    seen = inside & ~hidden
    seen[0] = times == times[start]
    np.testing.assert_array_equal(tracks.visible, seen)
    assert not inside.all()
    assert hidden.any()


def test_an_image_that_shows_nothing_has_no_points(capture):
    def empty(state, view):
        rendering = render(state, view)
        return rendering._replace(alpha=0 * rendering.alpha)

    with pytest.raises(
        ValueError, match=r"renders no surface at time=.* train for more"
    ):
        surface_tracks.follow(moved, empty, state_of(1.0), capture, 5)
