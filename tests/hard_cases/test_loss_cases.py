"""Losses and measures at their hard points, and in half precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.hard_losses import CASES
from gaussians_jax.effects import spectral
from nerfies_jax.measure import geometry_quality, image_quality
from nerfies_jax.training import losses
from tests.hard_cases import checks


@checks.by_case(CASES)
def test_held(case, dtype):
    checks.hold(case, dtype)


@pytest.mark.hard_cases
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_textbook_form_is_caught(case):
    checks.catches_the_textbook(case)


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
    """Pictures of that type, their float32 copies, a mask of over 256 pixels."""
    rng = np.random.default_rng(0)
    image = rng.random((height, width, 3))
    target = np.clip(image + 0.1 * rng.normal(size=image.shape), 0, 1)
    half = jnp.asarray(image, kind), jnp.asarray(target, kind)
    wide = tuple(x.astype(jnp.float32) for x in half)
    return half, wide, jnp.asarray(rng.random((height, width)) < 0.6)


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", LOSSES)
def test_losses_of_bfloat16_pictures_are_those_of_their_float32_copies(name):
    """Counted and summed as they are, a masked mean was 1.7 times too large."""
    half, wide, mask = pair("bfloat16")
    both = jax.jit(jax.value_and_grad(LOSSES[name]))
    value, slope = both(*half, mask)
    expected, expected_slope = both(*wide, mask)
    assert value.dtype == jnp.float32
    assert slope.dtype == jnp.bfloat16
    assert abs(value - expected) <= 1e-6 * expected
    size = float(jnp.abs(expected_slope).max())
    # Slopes come back rounded to eight bits.
    np.testing.assert_allclose(
        np.asarray(slope, np.float32) / size, expected_slope / size, atol=5e-3
    )


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    ("name", "kind"),
    [(name, "bfloat16") for name in MEASURES] + [("l1", "float16")],
)
def test_measures_of_half_precision_pictures_are_those_of_float32(name, kind):
    half, wide, mask = pair(kind)
    measure = jax.jit((LOSSES | MEASURES)[name])
    expected = measure(*wide, mask)
    # The second: a render in float32 against pictures kept in half precision.
    for found in (measure(*half, mask), measure(wide[0], half[1], mask)):
        assert found.dtype == jnp.float32
        assert abs(found - expected) <= 1e-6 * abs(expected)


@pytest.mark.hard_cases
def test_a_float16_picture_may_have_more_pixels_than_float16_counts():
    """70 000 pixels were infinitely many: a mean of 0, and 100 dB."""
    half = jnp.zeros((700, 100, 1), jnp.float16), jnp.ones((700, 100, 1), jnp.float16)
    mask = jnp.ones((700, 100), bool)
    assert losses.l1(*half, mask) == 1
    assert image_quality.masked_psnr(*half, mask) == 0


@pytest.mark.hard_cases
@pytest.mark.parametrize("level", [0.5, 1000.0])
def test_ssim_under_jit_is_about_one_level(level):
    """Contracted in one place and not in another, the mean of the target was two."""
    rng = np.random.default_rng(0)
    both = level + 0.5 * rng.integers(-2, 3, (2, 12, 13, 1))
    found = jax.jit(losses.dssim_map)(*jnp.asarray(both, jnp.float32))
    with jax.enable_x64(True):
        exact = jax.jit(losses.dssim_map)(*jnp.asarray(both, jnp.float64))
    np.testing.assert_allclose(found, exact, atol=1e-6)
    valid = [jnp.asarray(x, jnp.float32) for x in both]
    found = jax.jit(image_quality.ms_ssim, static_argnames="scales")(*valid, scales=1)
    expected = 1 - np.asarray(exact)[5:-5, 5:-5].mean()
    assert abs(found - expected) < 1e-6


@pytest.mark.hard_cases
@pytest.mark.parametrize("kind", ["bfloat16", "float16"])
def test_depths_flows_and_tracks_in_half_precision_are_counted(kind, rng):
    truth = rng.uniform(1, 5, 900)
    found = truth + 0.2 * rng.normal(size=900)
    mask = jnp.asarray(rng.random(900) < 0.6)
    half = jnp.asarray(found, kind), jnp.asarray(truth, kind)
    wide = tuple(x.astype(jnp.float32) for x in half)

    def measures(found, truth):
        pixels = found.reshape(450, 2), truth.reshape(450, 2)
        return (
            geometry_quality.depth_errors(found, truth, mask),
            geometry_quality.align_depth(found, truth, mask),
            geometry_quality.flow_errors(*pixels, mask[:450]),
            geometry_quality.track_errors(*pixels, mask[:450], 0.3),
        )

    compiled = jax.jit(measures)
    for value, expected in zip(
        jax.tree.leaves(compiled(*half)),
        jax.tree.leaves(compiled(*wide)),
        strict=True,
    ):
        assert value.dtype == expected.dtype
        np.testing.assert_allclose(value, expected, rtol=1e-6)
