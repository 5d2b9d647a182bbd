"""Cameras, sizes and images for who looks around."""

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
def test_an_image_of_any_size_fills_the_window(aspect):
    """The corners of the window, by its own field of view, are those of the image."""
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


def test_a_pyramid_of_tiles_ends_at_the_full_size():
    assert interactive.pyramid((176, 132), 2048) == ((44, 33), 3)
    assert interactive.pyramid((176, 132), 65536) == ((176, 132), 1)
    # Not evenly divisible: a few pixels more.
    uneven = interactive.pyramid((1000, 801), 2048)
    assert uneven == ((32, 26), 6)
    assert uneven.size(5) == (1024, 832)
    # However few pixels a tile is to have, there is something to be seen of it.
    assert interactive.pyramid((40, 30), 10) == ((20, 15), 2)
    tiles = uneven.tiles(2)
    assert len(set(tiles)) == 16
    assert set(tiles[:4]) == {(1, 1), (1, 2), (2, 1), (2, 2)}


def test_tiles_show_their_part_of_the_image():
    eye = Eye(tuple(TURN.as_quat(scalar_first=True).tolist()), (0.1, -2, 3), 0.8, 1.5)
    pyramid = interactive.pyramid((80, 60), 1200)
    whole = interactive.camera_of(eye, pyramid.size(1))
    point = np.float32(TURN.apply([0.9, 0.7, 4.0]) + eye.position)
    pixel, _ = jax.jit(cameras.project)(whole, point)
    tile = interactive.tile_camera(whole, pyramid, (1, 1))
    within, _ = jax.jit(cameras.project)(tile, point)
    np.testing.assert_allclose(within, pixel - np.float32([40, 30]), atol=1e-4)
    assert (within > 0).all()


def test_images_are_coarse_while_the_view_moves_and_reach_full_size_at_rest():
    def rendered_levels(tile_seconds, moving, complete, levels=4):
        """Levels rendered one after another until there is nothing to do."""
        order = []
        while True:
            level = interactive.next_level(tile_seconds, levels, complete, moving)
            if level is None:
                return order
            order.append(level)
            complete = level

    assert rendered_levels(None, False, None) == [0, 3]
    assert rendered_levels(0.01, True, None) == [
        1
    ]  # 4 tiles; 16 would take longer than 0.1 s
    assert rendered_levels(0.01, False, None) == [
        1,
        2,
        3,
    ]  # 64 tiles are not waited for
    assert rendered_levels(0.001, False, None) == [3]
    # However long a tile takes, the finest image comes.
    assert rendered_levels(100.0, True, None) == [0]
    assert rendered_levels(100.0, False, 0) == [1, 2, 3]


def test_channels_show_what_they_are_called():
    alpha = np.float32([[0.0, 1.0]])
    color, depth = np.float32([[[0, 0, 0], [1, 0.5, 2]]]), np.float32([[0.0, 3.0]])
    rendering = Rendering(color, alpha, depth)

    def image(channel, **rest):
        return interactive.as_channel(channel, rendering, **rest)

    assert image("color").image[0, 1].tolist() == [255, 128, 255]
    assert image("opacity").image[0].tolist() == [[0] * 3, [255] * 3]
    shown = image("depth", limits=(1.0, 3.0)).image[0]
    assert shown[0].tolist() == [128] * 3  # nothing there
    assert shown[1, 2] > shown[1, 0]  # far: the dark end of viridis
    distance = np.float32([[np.nan, 0.2]])
    near = image("motion", distance=distance)
    far = image("motion", distance=distance, limits=(0.0, 2.0))
    assert (near.high, far.high) == (pytest.approx(0.2), 2.0)
    assert near.image[0, 0].tolist() == [128] * 3
    assert near.image[0, 1].sum() > far.image[0, 1].sum() > 0
    # What moved nothing at all is black, not the middle of a range of no length.
    still = image("motion", distance=np.zeros((1, 2), np.float32))
    assert still.image.max() < 10
    with pytest.raises(ValueError, match="must be one of color, depth"):
        image("heat")
