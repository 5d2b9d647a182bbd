"""Losses and measures at their hard points, and in half precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.hard_cases import images as image_cases
from experiments.hard_cases import losses as loss_cases
from gaussians_jax.losses import spectral
from nerfies_jax.metrics import geometry_quality, image_quality
from nerfies_jax.training import losses
from tests.experiments.hard_cases import checks

pytestmark = pytest.mark.hard_cases
CASES = loss_cases.CASES + image_cases.CASES
test_held = checks.by_case(CASES)


WAVELET, FOURIER = spectral.WaveletSpec(), spectral.FourierSpec()
LOSSES = {
    "l1": losses.l1,
    "mse": losses.mse,
    "photometric": losses.photometric,
    "wavelet": lambda x, y, m: spectral.wavelet_loss(WAVELET, x, y, m),
    "fourier": lambda x, y, m: spectral.fourier_loss(FOURIER, x, y, m),
}
MEASURES = {
    "psnr": lambda x, y, _: image_quality.psnr(x, y),
    "masked_psnr": image_quality.masked_psnr,
    "ssim": lambda x, y, _: image_quality.ssim(x, y),
    "ms_ssim": lambda x, y, _: image_quality.ms_ssim(x, y, scales=2),
    "masked_ssim": image_quality.masked_ssim,
    "partial_ssim": image_quality.partial_ssim,
}


def pair(kind, height=37, width=29):
    """Images of that type, their float32 copies, a mask of over 256 pixels."""
    rng = np.random.default_rng(0)
    image = rng.random((height, width, 3))
    target = np.clip(image + 0.1 * rng.normal(size=image.shape), 0, 1)
    half = tuple(x.astype(jnp.dtype(kind)) for x in (image, target))
    wide = tuple(x.astype(np.float32) for x in half)
    return half, wide, rng.random((height, width)) < 0.6


@jax.jit
def every_slope(image, target, mask):
    return {
        name: jax.value_and_grad(loss)(image, target, mask)
        for name, loss in LOSSES.items()
    }


@jax.jit
def every_measure(image, target, mask):
    return {name: f(image, target, mask) for name, f in MEASURES.items()}


@pytest.mark.full
def test_losses_of_bfloat16_images_are_those_of_their_float32_copies():
    """Counted and summed as they are, a masked mean was 1.7 times too large."""
    half, wide, mask = pair("bfloat16")
    exact = every_slope(*wide, mask)
    for name, (value, slope) in every_slope(*half, mask).items():
        expected, expected_slope = exact[name]
        assert value.dtype == jnp.float32, name
        assert slope.dtype == jnp.bfloat16, name
        assert abs(value - expected) <= 1e-6 * expected, name
        slope, expected_slope = (np.float32(x) for x in (slope, expected_slope))
        size = np.abs(expected_slope).max()
        # Slopes come back rounded to eight bits.
        np.testing.assert_allclose(slope / size, expected_slope / size, atol=5e-3)


@pytest.mark.full
def test_measures_of_half_precision_images_are_those_of_float32():
    """In bfloat16, and of a float32 render beside a bfloat16 image."""
    half, wide, mask = pair("bfloat16")
    exact = every_measure(*wide, mask)
    for both in (half, (wide[0], half[1])):
        for name, value in every_measure(*both, mask).items():
            assert value.dtype == jnp.float32, name
            assert abs(value - exact[name]) <= 1e-6 * abs(exact[name]), name


def test_a_float16_image_may_have_more_pixels_than_float16_counts():
    """70 000 pixels were infinitely many: a mean of 0, and 100 dB."""
    half = np.zeros((700, 100, 1), np.float16), np.ones((700, 100, 1), np.float16)
    mask = np.ones((700, 100), bool)
    assert jax.jit(losses.l1)(*half, mask) == 1
    assert jax.jit(image_quality.masked_psnr)(*half, mask) == 0


@pytest.mark.full
@pytest.mark.parametrize("level", [0.5, 1000.0])
def test_ssim_under_jit_is_about_one_level(level):
    """Contracted in one place and not in another, the mean of the target was two."""
    rng = np.random.default_rng(0)
    both = level + 0.5 * rng.integers(-2, 3, (2, 12, 13, 1))
    similarity = jax.jit(losses.dssim_map)(*np.float32(both))
    with jax.enable_x64(True):
        exact = jax.jit(losses.dssim_map)(*both)
    np.testing.assert_allclose(similarity, exact, atol=1e-6)
    valid = jax.jit(image_quality.ms_ssim, static_argnames="scales")
    similarity = valid(*np.float32(both), scales=1)
    expected = 1 - np.asarray(exact)[5:-5, 5:-5].mean()
    assert abs(similarity - expected) < 1e-6


@jax.jit
def geometry_measures(estimate, truth, mask):
    pixels = estimate.reshape(450, 2), truth.reshape(450, 2)
    return (
        geometry_quality.depth_errors(estimate, truth, mask),
        geometry_quality.align_depth(estimate, truth, mask),
        geometry_quality.flow_errors(*pixels, mask[:450]),
        geometry_quality.track_errors(*pixels, mask[:450], 0.3),
    )


@pytest.mark.full
@pytest.mark.parametrize("kind", ["bfloat16", "float16"])
def test_depths_flows_and_tracks_in_half_precision_are_counted(kind, rng):
    truth = rng.uniform(1, 5, 900)
    estimate = truth + 0.2 * rng.normal(size=900)
    mask = rng.random(900) < 0.6
    half = [x.astype(jnp.dtype(kind)) for x in (estimate, truth)]
    wide = [x.astype(np.float32) for x in half]
    for value, expected in zip(
        jax.tree.leaves(geometry_measures(*half, mask)),
        jax.tree.leaves(geometry_measures(*wide, mask)),
        strict=True,
    ):
        assert value.dtype == expected.dtype
        np.testing.assert_allclose(value, expected, rtol=1e-6)
