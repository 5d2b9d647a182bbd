"""Taking the lens out of the images."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage as nd

from nerfies_jax.capture import pinholes, resampling
from nerfies_jax.geometry import camera as cameras
from tests import scenes


def through_a_lens(capture, radial, tangential=(0.0, 0.0)):
    """The same directions, seen through a lens: sampled from a smooth pattern."""
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


def test_an_undistorted_image_is_the_pinhole_s_own():
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


def test_pixels_outside_of_the_lens_are_marked():
    capture = scenes.tiny_capture()
    # Barrel distortion: the pinhole's corners lie outside the round image.
    flat = pinholes.as_pinholes(through_a_lens(capture, (0.4, 0.0, 0.0)))
    assert flat.valid is not None
    assert not flat.valid[:, 0, 0].any()
    assert flat.valid[:, 15, 20].all()
    assert "unobserved" in flat.notes[-1]


def test_masks_and_depth_move_with_the_image():
    capture = scenes.tiny_capture()
    bent = through_a_lens(capture, (-0.1, 0.0, 0.0))
    flat, wide = pinholes.as_pinholes(bent), pinholes.canvas(bent)
    assert flat.size == wide.size
    assert flat.depths.shape[1:] == wide.size[::-1]
    assert flat.moving.dtype == bool
    # The center of the lens does not move.
    center = flat.depths[:, 15 + wide.top, 20 + wide.left]
    np.testing.assert_array_equal(center, capture.depths[:, 15, 20])


def test_an_undistorted_image_contains_all_observed_pixels_and_leads_back_to_them():
    bent = through_a_lens(scenes.tiny_capture(), (-0.3, 0.0, 0.0))
    flat, wide = pinholes.as_pinholes(bent), pinholes.canvas(bent)
    assert pinholes.as_pinholes(bent).images is flat.images  # kept
    other = dataclasses.replace(bent, moving=~bent.moving)
    assert (pinholes.as_pinholes(other).moving != flat.moving).any()
    width, height = bent.size
    assert width < wide.size[0] < 1.5 * width
    assert height < wide.size[1] < 1.5 * height
    camera = cameras.take(bent.cameras, 0)
    everywhere = np.ones(wide.size[::-1], bool)
    assert pinholes.as_observed(everywhere, camera, wide, bent.size).all()
    left = np.zeros(wide.size[::-1], bool)
    left[:, : round(float(flat.cameras.principal_point_px[0, 0]))] = True
    back = pinholes.as_observed(left, camera, wide, bent.size)
    expected = np.arange(width) + 0.5 < float(camera.principal_point_px[0])
    np.testing.assert_array_equal(back, np.tile(expected, (height, 1)))


def test_a_fisheye_is_undistorted_up_to_a_bound():
    capture = scenes.tiny_capture()
    count = len(capture.ids)
    # 80 degrees in the corners, where the tangent is 5.
    lens = capture.cameras._replace(
        focal_px=np.full(count, 18, np.float32),
        fisheye=np.zeros((count, 4), np.float32),
    )
    bent = dataclasses.replace(capture, cameras=lens)
    assert pinholes.scorable(bent) is bent
    flat = pinholes.as_pinholes(bent)
    assert flat.size[0] == capture.size[0] + 2 * (capture.size[0] // 4)
    assert flat.cameras.fisheye is None
    assert pinholes.as_pinholes(flat) is flat
