"""Cameras, sizes and pictures for who looks around."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerfies_jax.evaluation import interactive
from nerfies_jax.evaluation.interactive import Eye
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training.model import Rendering

TURN = Rotation.from_rotvec([0.3, -0.5, 0.2])


@pytest.mark.parametrize("aspect", [0.5, 2.2])
def test_a_picture_of_any_size_fills_the_window(aspect):
    """The corners of the window, by its own field of view, are those of the picture."""
    quaternion = tuple(TURN.as_quat(scalar_first=True).tolist())
    eye = Eye(quaternion, (0.1, -2.0, 3.0), fov_rad=0.8, aspect=aspect)
    size = (40, 30)
    camera = interactive.camera_of(eye, size)
    cameras.validate(camera, size)
    up = np.tan(0.4)
    for across, down, pixel in ((-1, -1, (0, 0)), (1, -1, (40, 0)), (0, 1, (20, 30))):
        in_camera = 7 * np.array([across * aspect * up, down * up, 1.0])
        point = np.float32(TURN.apply(in_camera) + eye.position)
        seen, depth = jax.jit(cameras.project)(camera, point)
        np.testing.assert_allclose(seen, pixel, atol=1e-4)
        assert depth == pytest.approx(7, rel=1e-5)


def test_sizes_are_halves_down_to_what_still_shows_something():
    assert interactive.ladder((1000, 801)) == (
        *((125, 100), (250, 200), (500, 400)),
        (1000, 801),
    )
    assert interactive.ladder((176, 132)) == ((44, 33), (88, 66), (176, 132))
    assert interactive.ladder((40, 30)) == ((40, 30),)


def test_pictures_are_coarse_while_the_view_moves_and_sharpen_when_it_rests():
    seconds = [None, None, None, None]

    def draw(moving, shown, takes):
        """Rungs drawn one after another until there is nothing to do."""
        drawn = []
        while (rung := interactive.next_rung(seconds, moving, shown)) is not None:
            drawn.append(shown := rung)
            seconds[rung] = takes[rung]
        return drawn

    quick = [0.01, 0.03, 0.09, 0.5]
    # Nothing is known at first: each size is tried after the one before it.
    assert draw(True, None, quick) == [0, 1]
    assert draw(False, 1, quick) == [2, 3]
    assert draw(True, None, quick) == [2]
    assert draw(False, None, quick) == [2, 3]
    # A field: even the coarsest is slow, and the finest is not waited for.
    seconds[:] = [None] * 4
    slow = [0.5, 1.9, 8.0, 32.0]
    assert draw(True, None, slow) == [0]
    assert draw(False, 0, slow) == [1]


def test_channels_show_what_they_are_called():
    alpha = np.float32([[0.0, 1.0]])
    colour, depth = np.float32([[[0, 0, 0], [1, 0.5, 2]]]), np.float32([[0.0, 3.0]])
    rendering = Rendering(colour, alpha, depth)

    def picture(channel, **rest):
        return interactive.as_channel(channel, rendering, **rest)

    assert picture("colour").picture[0, 1].tolist() == [255, 128, 255]
    assert picture("opacity").picture[0].tolist() == [[0] * 3, [255] * 3]
    shown = picture("depth", limits=(1.0, 3.0)).picture[0]
    assert shown[0].tolist() == [128] * 3  # nothing there
    assert shown[1, 2] > shown[1, 0]  # far: the dark end of viridis
    distance = np.float32([[np.nan, 0.2]])
    near = picture("motion", distance=distance)
    far = picture("motion", distance=distance, limits=(0.0, 2.0))
    assert (near.high, far.high) == (pytest.approx(0.2), 2.0)
    assert near.picture[0, 0].tolist() == [128] * 3
    assert near.picture[0, 1].sum() > far.picture[0, 1].sum() > 0
    # What moved nothing at all is black, not the middle of a range of no length.
    still = picture("motion", distance=np.zeros((1, 2), np.float32))
    assert still.picture.max() < 10
    with pytest.raises(ValueError, match="there are colour, depth"):
        picture("heat")
