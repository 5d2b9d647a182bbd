"""Taking the lens out of the pictures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage as nd

from nerfies_jax.capture import pinholes, resampling
from nerfies_jax.geometry import camera as cameras
from tests import scenes


def through_a_lens(capture, radial, tangential=(0.0, 0.0)):
    """The same directions, filmed through a lens: sampled from a smooth pattern."""
    count = len(capture.ids)
    lens = capture.cameras._replace(
        radial=np.tile(np.float32(radial), (count, 1)),
        tangential=np.tile(np.float32(tangential), (count, 1)),
    )
    images = np.stack(
        [pattern(cameras.take(lens, row), capture) for row in range(count)]
    )
    return dataclasses.replace(capture, images=images, cameras=lens)


@jax.jit
def look(camera, pixels):
    return jax.vmap(lambda pixel: cameras.unproject(camera, pixel)[0])(pixels)


def pattern(camera, capture):
    """A smooth color of the viewing direction alone, as this camera sees it."""
    width, height = capture.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32)
    direction = look(jax.tree.map(jnp.asarray, camera), pixels)
    direction = np.asarray(direction).reshape(height, width, 3)
    return np.round(127 + 120 * np.sin(3 * direction)).astype(np.uint8)


def test_an_undistorted_picture_is_the_pinhole_s_own():
    capture = scenes.tiny_capture()
    bent = through_a_lens(capture, (-0.2, 0.05, 0.0), (0.003, -0.002))
    flat = pinholes.as_pinholes(bent)
    assert not flat.cameras.radial.any()
    assert pinholes.as_pinholes(flat) is flat
    for row in range(len(flat.ids)):
        expected = pattern(cameras.take(flat.cameras, row), flat).astype(int)
        seen = np.ones(expected.shape[:2], bool)
        if flat.valid is not None:
            seen = flat.valid[row]
        assert seen.mean() > 0.7
        # Rounding, of the pattern and of what is sampled from it.
        assert np.abs(flat.images[row].astype(int) - expected)[seen].max() <= 2


def test_resampling_there_and_back_keeps_fine_texture(rng):
    noise = nd.gaussian_filter(rng.normal(size=(64, 80, 3)), (1, 1, 0))
    image = np.uint8(np.clip(127 + 40 * noise / noise.std(), 0, 255).round())
    rows, columns = np.indices(image.shape[:2], np.float32)
    shifted = resampling.lanczos(image, np.stack([rows + 0.5, columns + 0.5]))
    back = resampling.lanczos(shifted, np.stack([rows - 0.5, columns - 0.5]))
    error = (back.astype(float) - image)[8:-8, 8:-8]
    # 47 dB; 38 dB with a cubic filter and 28 dB with a bilinear one.
    assert 10 * np.log10(255**2 / np.mean(error**2)) > 44


def test_pixels_the_lens_did_not_film_are_marked():
    capture = scenes.tiny_capture()
    # Barrel distortion: the pinhole's corners lie outside the round picture.
    flat = pinholes.as_pinholes(through_a_lens(capture, (0.4, 0.0, 0.0)))
    assert flat.valid is not None
    assert not flat.valid[:, 0, 0].any()
    assert flat.valid[:, 15, 20].all()
    assert "unobserved" in flat.notes[-1]


def test_masks_and_depth_move_with_the_picture():
    capture = scenes.tiny_capture()
    flat = pinholes.as_pinholes(through_a_lens(capture, (-0.1, 0.0, 0.0)))
    assert flat.depths.shape == capture.depths.shape
    assert flat.moving.dtype == bool
    # The middle of the picture does not move.
    np.testing.assert_array_equal(flat.depths[:, 15, 20], capture.depths[:, 15, 20])
