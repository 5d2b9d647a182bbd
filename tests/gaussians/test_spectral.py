"""Haar pyramid, Fourier amplitudes, gates: matrices, np.fft and hard cases."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core import components
from gaussians_jax.core.splats import Params
from gaussians_jax.losses import spectral
from gaussians_jax.losses.spectral import FourierSpec, Gates, SpectralSpec, WaveletSpec
from nerfies_jax.training.effects import (
    Observation,
    PenaltyContext,
    values,
    weighted_sum,
)
from nerfies_jax.training.model import Rendering
from tests import gradients
from tests.gaussians import bound
from tests.gaussians.shared import any_nonzero, full, jitted, put

EVERY_SIZE = pytest.mark.parametrize("size", [(1, 1), (7, 5), *full(((12, 10),))])
haar_pyramid = jitted(spectral.haar_pyramid, static_argnums=1)
wavelet_loss = jitted(spectral.wavelet_loss, static_argnums=0)
fourier_loss = jitted(spectral.fourier_loss, static_argnums=0)

TINY = {"float32": 1e-6, "float64": 1e-14}


def random_image(rng, height, width, dtype="float64", channels=3):
    return rng.uniform(size=(height, width, channels)).astype(dtype)


def haar_matrices(size):
    """Rows of pair sums and pair differences over sqrt 2, by the definition."""
    sums = np.kron(np.eye(size // 2), [1, 1]) * math.sqrt(0.5)
    differences = np.kron(np.eye(size // 2), [1, -1]) * math.sqrt(0.5)
    return sums, differences


def pyramid_by_matrices(image, levels):
    """One channel, extended by hand, transformed by explicit orthonormal matrices."""
    high, low = [], np.asarray(image, np.float64)
    for _ in range(levels):
        if low.shape[0] % 2:
            low = np.vstack([low, low[-1:]])
        if low.shape[1] % 2:
            low = np.hstack([low, low[:, -1:]])
        (sy, dy), (sx, dx) = haar_matrices(low.shape[0]), haar_matrices(low.shape[1])
        high.append((sy @ low @ dx.T, dy @ low @ sx.T, dy @ low @ dx.T))
        low = sy @ low @ sx.T
    return high, low


@pytest.mark.hard_cases
@EVERY_SIZE
def test_the_pyramid_is_that_of_explicit_orthonormal_matrices(size, dtype, rng):
    image = random_image(rng, *size, dtype)
    pyramid = haar_pyramid(image, 3)
    for channel in range(3):
        high, low = pyramid_by_matrices(image[..., channel], 3)
        np.testing.assert_allclose(pyramid.low[..., channel], low, rtol=4 * TINY[dtype])
        for bands, expected in zip(pyramid.high, high, strict=True):
            for band, exact in zip(bands, expected, strict=True):
                assert band.dtype == dtype
                np.testing.assert_allclose(
                    band[..., channel], exact, atol=8 * TINY[dtype]
                )


@pytest.mark.hard_cases
@EVERY_SIZE
@pytest.mark.parametrize("level", [1000.3, *full(0.1)])
def test_a_constant_has_no_high_bands_whatever_its_size(size, level, dtype):
    image = np.full((*size, 3), level, dtype)
    pyramid = haar_pyramid(image, 3)
    assert all(not np.any(band) for bands in pyramid.high for band in bands)


@EVERY_SIZE
def test_the_wavelet_loss_is_the_mean_square_of_every_high_band(size, dtype, rng):
    render, truth = random_image(rng, *size, dtype), random_image(rng, *size, dtype)
    spec = WaveletSpec(levels=3, level_factor=0.25)
    expected = 0.0
    for level in range(3):
        for band in range(3):
            squares = []
            for channel in range(3):
                first, _ = pyramid_by_matrices(render[..., channel], 3)
                second, _ = pyramid_by_matrices(truth[..., channel], 3)
                squares.append((first[level][band] - second[level][band]) ** 2)
            expected += 4.0**-level * np.mean(squares)
    got = float(wavelet_loss(spec, render, truth))
    assert got == pytest.approx(expected, rel=20 * TINY[dtype], abs=1e-30)


@pytest.mark.hard_cases
@EVERY_SIZE
def test_the_half_spectrum_counts_like_the_whole_one(size, dtype, rng):
    render, truth = random_image(rng, *size, dtype), random_image(rng, *size, dtype)
    whole = [
        np.abs(np.fft.fft2(np.asarray(image, np.float64), axes=(0, 1), norm="ortho"))
        for image in (render, truth)
    ]
    squares = (whole[0] - whole[1]) ** 2
    squares[0, 0] *= 0.25
    got = fourier_loss(FourierSpec(dc_weight=0.25), render, truth)
    assert float(got) == pytest.approx(
        np.mean(squares), rel=50 * TINY[dtype], abs=TINY[dtype]
    )


@pytest.mark.full
def test_the_fourier_loss_does_not_grow_with_the_image(rng):
    small, large = (
        fourier_loss(FourierSpec(), *rng.uniform(size=(2, side, side, 3)).astype("f4"))
        for side in (32, 128)
    )
    assert large == pytest.approx(small, rel=0.1)


@pytest.mark.parametrize("size", [(7, 5), *full(((1, 1),), ((8, 6),))])
def test_both_losses_have_the_slopes_of_central_differences(size, float64, rng):
    render, truth = put(random_image(rng, *size)), put(random_image(rng, *size))

    def wavelet(render):
        spec = WaveletSpec(levels=2, level_factor=0.5)
        # On one pixel the loss is zero: the square keeps the check from 0 / 0.
        return spectral.wavelet_loss(spec, render, truth) + jnp.sum(render**2)

    def fourier(render):
        return spectral.fourier_loss(FourierSpec(dc_weight=0.5), render, truth)

    for function in (wavelet, fourier):
        assert gradients.directional_error(function, render) < 1e-7


PATCH = (9, 6)
EVERYWHERE = np.ones(PATCH, bool)


@jitted
def values_and_slopes(render, truth, valid):
    """Wavelet and Fourier loss of the valid pixels, with their slopes in the render."""
    forms = {
        "wavelet": lambda x: spectral.wavelet_loss(WaveletSpec(), x, truth, valid),
        "fourier": lambda x: spectral.fourier_loss(FourierSpec(), x, truth, valid),
    }
    return {name: jax.value_and_grad(form)(render) for name, form in forms.items()}


@pytest.mark.hard_cases
@pytest.mark.parametrize("hole", [np.nan, 1e30, *full(np.inf)])
def test_pixels_that_are_not_valid_teach_nothing_whatever_they_hold(hole, dtype, rng):
    render, truth = random_image(rng, *PATCH, dtype), random_image(rng, *PATCH, dtype)
    valid = rng.uniform(size=PATCH) < 0.7
    keep = valid[..., None]
    by_hand = np.where(keep, render, truth)
    expected = {
        "wavelet": wavelet_loss(WaveletSpec(), by_hand, truth),
        "fourier": fourier_loss(FourierSpec(), by_hand, truth),
    }
    whole = values_and_slopes(render, truth, valid)
    holed = values_and_slopes(
        np.where(keep, render, render.dtype.type(hole)), truth, valid
    )
    for name, (value, grad) in whole.items():
        assert float(value) == pytest.approx(float(expected[name]), rel=1e-6)
        slope = np.asarray(holed[name][1])
        assert np.all(np.isfinite(slope))
        assert np.any(slope)
        assert not np.any(np.where(keep, 0, slope))
        np.testing.assert_allclose(slope, np.where(keep, grad, 0), atol=1e-7)

    if not np.isfinite(hole):  # an undistorted truth holds NaN where it saw nothing
        unseen, blackened = (
            values_and_slopes(render, np.where(keep, truth, value), valid)
            for value in (truth.dtype.type(hole), truth.dtype.type(0))
        )
        for name, (value, _) in unseen.items():
            assert float(value) == float(blackened[name][0])


@pytest.mark.hard_cases
def test_nothing_valid_costs_nothing(dtype, rng):
    weight = Gates(np.asarray(0.1, dtype), np.asarray(0.1, dtype))
    images = (random_image(rng, *PATCH, dtype) for _ in range(2))

    @jitted
    def cost(*args):
        return weighted_sum(spectral.terms(SpectralSpec(), *args))

    assert cost(weight, *images, ~EVERYWHERE) == 0


weights_at = jitted(spectral.weights, static_argnums=(0, 3))


@pytest.mark.parametrize("gate", spectral.GATES)
@pytest.mark.parametrize("opening", [0.9, *full(0.5)])
def test_every_gate_starts_at_its_opening(gate, opening):
    spec = SpectralSpec(WaveletSpec(0.2), FourierSpec(0.6), gate=gate, opening=opening)
    start = spectral.init(spec) if gate in spectral.LEARNED else None
    weight = weights_at(spec, start, np.int32(0), 100)
    np.testing.assert_allclose(weight, [0.2 * opening, 0.6 * opening], rtol=2e-7)
    assert spectral.init(SpectralSpec()) == Gates(0.0, 0.0)  # as in the paper


def test_the_slope_of_a_learned_gate_is_never_negative_and_the_closed_form(
    float64, rng
):
    spec = SpectralSpec()
    render, truth = random_image(rng, 12, 10), random_image(rng, 12, 10)

    def value(gates):
        weight = spectral.weights(spec, gates, jnp.int32(0), 10)
        return weighted_sum(spectral.terms(spec, weight, *map(put, (render, truth))))

    slope_of = jitted(jax.grad(value))
    unweighted = np.array(
        [
            wavelet_loss(spec.wavelet, render, truth),
            fourier_loss(spec.fourier, render, truth),
        ]
    )
    for logit in (-9.0, -3.0, 0.0, 3.0, 30.0):
        grad = np.array(slope_of(Gates(np.asarray(logit), np.asarray(logit))))
        share = 1 / (1 + math.exp(-logit))
        expected = 0.1 * share * (1 - share) * unweighted
        np.testing.assert_allclose(grad, expected, rtol=1e-12, atol=1e-15)
        assert (grad >= 0).all()
        # Where the sigmoid is one to rounding nothing is left.
        assert logit == 30 or (grad > 0).all()
    gates = put(Gates(0.5, -0.5))
    assert gradients.directional_error(value, gates) < 1e-6


@functools.partial(jax.jit, static_argnums=0)
def opening(spec, logit):
    def weight(logit):
        return spectral.weights(spec, Gates(logit, logit), jnp.int32(0), 10).wavelet

    return jax.value_and_grad(weight)(logit)


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    ("gate", "least"), [("learned", 1e-4), ("floor", 0.05)], ids=["learned", "floor"]
)
@pytest.mark.parametrize("logit", [-1e4, -30.0, *full(-200.0)])
def test_a_shut_gate_keeps_its_least_opening_and_a_finite_slope(
    gate, least, logit, dtype
):
    spec = SpectralSpec(WaveletSpec(1.0), FourierSpec(1.0), gate=gate)

    value, grad = opening(spec, np.asarray(logit, dtype))
    assert float(value) == pytest.approx(least, rel=1e-6)
    assert 0 <= float(grad) < 1e-12


def test_a_schedule_falls_along_half_a_cosine_to_exactly_nothing():
    spec = SpectralSpec(WaveletSpec(1.0), None, gate="schedule", after=20)
    weights = [
        weights_at(spec, None, np.int32(i), 100) for i in (0, 19, 20, 40, 100, 200)
    ]
    factors = [float(weight.wavelet) for weight in weights]
    exact = [0, 0, 0.5, 0.25 * (1 + math.cos(math.pi / 4)), 0, 0]
    np.testing.assert_allclose(factors, exact, atol=1e-7)
    assert factors[0] == factors[1] == factors[-2] == factors[-1] == 0
    assert weights[0].fourier is None


def shot_of(rng, size=(6, 6)):
    render, truth = (random_image(rng, *size, "float32") for _ in range(2))
    flat = np.zeros(size, np.float32)
    return put(Observation(Rendering(render, flat, flat), truth, None, None))


@pytest.mark.parametrize("gate", spectral.GATES)
def test_the_effect_weighs_logs_and_trains_what_its_gate_has(gate, rng):
    spec = SpectralSpec(gate=gate, after=3)
    regularizer, shot = bound.motion(spec, 10), shot_of(rng)
    learned = gate in spectral.LEARNED
    effect = components.compile_regularizer(regularizer)
    assert (effect.init is not None) == (effect.learning_rate is not None) == learned
    gates = put(spectral.init(spec), "float32") if learned else None

    @jitted
    @functools.partial(jax.value_and_grad, has_aux=True)
    def both(gates, step):
        context = PenaltyContext(None, step, None, None, observation=shot)
        terms = regularizer.loss(Params({}, {spectral.NAME: gates}), context)
        return weighted_sum(terms), values(terms)

    (early, _), grad = both(gates, np.int32(2))
    assert not any_nonzero((early, grad))
    (later, metrics), grad = both(gates, np.int32(3))
    assert all(part > 0 for part in jax.tree.leaves(grad))
    by_hand = sum(metrics[f"{x}_weight"] * metrics[x] for x in ("wavelet", "fourier"))
    assert later == pytest.approx(by_hand, rel=1e-6)
    np.testing.assert_allclose(metrics["wavelet_weight"], 0.05, rtol=1e-6)
    if learned:
        np.testing.assert_allclose(effect.learning_rate(put(5)).shared, 1e-2)
