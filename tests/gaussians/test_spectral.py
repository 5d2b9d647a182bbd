"""Haar pyramid, Fourier amplitudes, gates: matrices, np.fft and hard cases."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.effects import spectral
from gaussians_jax.effects.spectral import FourierSpec, Gates, SpectralSpec, WaveletSpec
from gaussians_jax.optimiser import scale_by_row_adam
from gaussians_jax.splats import Params
from nerfies_jax.training.effects import (
    Observation,
    PenaltyContext,
    values,
    weighted_sum,
)
from nerfies_jax.training.model import Rendering
from nerfies_jax.training.updates import apply_updates
from tests import gradients

SIZES = [(1, 1), (7, 5), (12, 10)]
# Compiled whole: operation by operation, every new shape costs ten compilations.
haar_pyramid = jax.jit(spectral.haar_pyramid, static_argnums=1)
wavelet_loss = jax.jit(spectral.wavelet_loss, static_argnums=0)
fourier_loss = jax.jit(spectral.fourier_loss, static_argnums=0)

TINY = {"float32": 1e-6, "float64": 1e-14}


def picture(rng, height, width, dtype="float64", channels=3):
    return rng.uniform(size=(height, width, channels)).astype(dtype)


def haar_matrices(size):
    """Rows of pair sums and pair differences over sqrt 2, by the definition."""
    half = size // 2
    sums, differences = np.zeros((half, size)), np.zeros((half, size))
    for i in range(half):
        sums[i, 2 * i] = sums[i, 2 * i + 1] = math.sqrt(0.5)
        differences[i, 2 * i], differences[i, 2 * i + 1] = (
            math.sqrt(0.5),
            -math.sqrt(0.5),
        )
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
@pytest.mark.parametrize("size", SIZES)
def test_the_pyramid_is_that_of_explicit_orthonormal_matrices(size, dtype, rng):
    image = picture(rng, *size, dtype)
    pyramid = jax.tree.map(np.asarray, haar_pyramid(image, 3))
    for channel in range(3):
        high, low = pyramid_by_matrices(image[..., channel], 3)
        np.testing.assert_allclose(pyramid.low[..., channel], low, rtol=4 * TINY[dtype])
        for bands, expected in zip(pyramid.high, high, strict=True):
            for band, exact in zip(bands, expected, strict=True):
                assert band.dtype == dtype
                np.testing.assert_allclose(
                    band[..., channel], exact, atol=8 * TINY[dtype]
                )


def test_upright_edges_are_in_hl_level_ones_in_lh_and_a_checkerboard_in_hh():
    ramp = (np.arange(4) % 2).astype(np.float32)
    upright = np.tile(ramp[None, :, None], (4, 1, 1))
    checks = (upright + upright.swapaxes(0, 1)) % 2
    for image, own in ((upright, 0), (upright.swapaxes(0, 1), 1), (checks, 2)):
        bands = haar_pyramid(image, 1).high[0]
        sizes = [float(np.max(np.abs(band))) for band in bands]
        assert sizes[own] == 1
        assert sum(sizes) == 1


def test_the_pyramid_keeps_the_energy_of_a_picture_it_need_not_extend(dtype, rng):
    image = picture(rng, 24, 40, dtype)
    parts = jax.tree.leaves(haar_pyramid(image, 3))
    energy = sum(np.sum(np.square(part)) for part in parts)
    assert energy == pytest.approx(np.sum(image**2), rel=4 * TINY[dtype])


@pytest.mark.hard_cases
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("level", [0.1, 1000.3])
def test_a_constant_has_no_high_bands_whatever_its_size(size, level, dtype):
    image = np.full((*size, 3), level, dtype)
    pyramid = haar_pyramid(image, 3)
    assert all(not np.any(band) for bands in pyramid.high for band in bands)


@pytest.mark.parametrize("size", SIZES)
def test_the_wavelet_loss_is_the_mean_square_of_every_high_band(size, dtype, rng):
    render, truth = picture(rng, *size, dtype), picture(rng, *size, dtype)
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


@pytest.mark.full
def test_white_noise_costs_the_same_at_every_level(rng):
    noise = rng.normal(size=(128, 128, 3)).astype(np.float32)
    costs = [
        float(wavelet_loss(WaveletSpec(levels=levels), noise, 0 * noise))
        for levels in (1, 2, 3)
    ]
    # Three bands of unit variance each; the coarsest has 768 coefficients a band.
    np.testing.assert_allclose(np.diff([0, *costs]), 3, rtol=0.1)


@pytest.mark.hard_cases
@pytest.mark.parametrize("size", SIZES)
def test_the_half_spectrum_counts_like_the_whole_one(size, dtype, rng):
    render, truth = picture(rng, *size, dtype), picture(rng, *size, dtype)
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
@pytest.mark.parametrize("size", SIZES)
def test_amplitudes_have_the_energy_of_the_picture(size, dtype, rng):
    image = picture(rng, *size, dtype)
    cost = fourier_loss(FourierSpec(), image, 0 * image)
    # Parseval: against black, the loss is the mean square.
    assert float(cost) == pytest.approx(np.mean(image**2), rel=9 * TINY[dtype])


@pytest.mark.full
def test_the_fourier_loss_does_not_grow_with_the_picture(rng):
    costs = [
        float(
            fourier_loss(
                FourierSpec(), *(picture(rng, side, side, "float32") for _ in range(2))
            )
        )
        for side in (32, 128)
    ]
    assert costs[1] == pytest.approx(costs[0], rel=0.1)


def test_the_fourier_loss_is_blind_to_a_roll_and_the_wavelet_loss_is_not(dtype, rng):
    image = picture(rng, 24, 30, dtype)
    rolled = np.roll(image, (3, 5), (0, 1))
    blind = float(fourier_loss(FourierSpec(), rolled, image))
    assert blind < {"float32": 1e-11, "float64": 1e-28}[dtype]
    assert float(wavelet_loss(WaveletSpec(), rolled, image)) > 0.1


def test_without_its_dc_weight_a_change_of_brightness_is_free(dtype, rng):
    image = picture(rng, 10, 12, dtype)
    brighter = image + image.dtype.type(0.25)
    free = fourier_loss(FourierSpec(dc_weight=0.0), brighter, image)
    assert float(free) < {"float32": 1e-12, "float64": 1e-28}[dtype]
    # A shift s of all pixels changes one bin of each channel by s sqrt(pixels).
    counted = fourier_loss(FourierSpec(), brighter, image)
    assert float(counted) == pytest.approx(0.25**2, rel=20 * TINY[dtype])


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (8, 6)])
def test_both_losses_have_the_slopes_of_central_differences(size, float64, rng):
    truth = picture(rng, *size)

    def wavelet(render):
        spec = WaveletSpec(levels=2, level_factor=0.5)
        # On one pixel the loss is zero: the square keeps the check from 0 / 0.
        return wavelet_loss(spec, render, truth) + jnp.sum(render**2)

    def fourier(render):
        return fourier_loss(FourierSpec(dc_weight=0.5), render, truth)

    for function in (wavelet, fourier):
        assert gradients.directional_error(function, picture(rng, *size)) < 1e-7


PATCH = (9, 6)
EVERYWHERE = np.ones(PATCH, bool)


@jax.jit
def values_and_slopes(render, truth, valid):
    """Wavelet and Fourier loss of the valid pixels, with their slopes in the render."""
    forms = {
        "wavelet": lambda x: spectral.wavelet_loss(WaveletSpec(), x, truth, valid),
        "fourier": lambda x: spectral.fourier_loss(FourierSpec(), x, truth, valid),
    }
    return {name: jax.value_and_grad(form)(render) for name, form in forms.items()}


@pytest.mark.hard_cases
@pytest.mark.parametrize("level", [0.0, 1e-42, 1e-20, 0.5])
def test_slopes_are_finite_where_amplitudes_vanish(level, dtype, rng):
    truth = picture(rng, *PATCH, dtype)
    _, grad = values_and_slopes(np.full_like(truth, level), truth, EVERYWHERE)[
        "fourier"
    ]
    assert np.all(np.isfinite(grad))
    if level == 0:
        assert not np.any(grad)


@pytest.mark.hard_cases
def test_slopes_are_zero_where_the_render_is_right(dtype, rng):
    truth = picture(rng, *PATCH, dtype)
    for value, grad in values_and_slopes(truth, truth, EVERYWHERE).values():
        assert float(value) == 0
        assert not np.any(grad)


@pytest.mark.hard_cases
@pytest.mark.parametrize("hole", [np.nan, np.inf, 1e30])
def test_pixels_that_are_not_valid_teach_nothing_whatever_they_hold(hole, dtype, rng):
    render, truth = picture(rng, *PATCH, dtype), picture(rng, *PATCH, dtype)
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
        found = np.asarray(holed[name][1])
        assert np.all(np.isfinite(found))
        assert np.any(found)
        assert not np.any(np.where(keep, 0, found))
        np.testing.assert_allclose(found, np.where(keep, grad, 0), atol=1e-7)

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
    pictures = (picture(rng, *PATCH, dtype) for _ in range(2))
    terms = jax.jit(spectral.terms, static_argnums=0)(
        SpectralSpec(), weight, *pictures, ~EVERYWHERE
    )
    assert float(weighted_sum(terms)) == 0


def step_of(number):
    return jnp.asarray(number, jnp.int32)


@pytest.mark.parametrize("gate", spectral.GATES)
@pytest.mark.parametrize("opening", [0.5, 0.9])
def test_every_gate_starts_at_its_opening(gate, opening):
    spec = SpectralSpec(WaveletSpec(0.2), FourierSpec(0.6), gate=gate, opening=opening)
    start = spectral.init(spec) if gate in spectral.LEARNED else None
    weight = spectral.weights(spec, start, step_of(0), 100)
    np.testing.assert_allclose(weight, [0.2 * opening, 0.6 * opening], rtol=2e-7)


def test_the_paper_starts_at_logits_of_zero():
    assert spectral.init(SpectralSpec()) == Gates(0.0, 0.0)


def test_the_slope_of_a_learned_gate_is_never_negative_and_the_closed_form(
    float64, rng
):
    spec = SpectralSpec()
    render, truth = (jnp.asarray(picture(rng, 8, 8)) for _ in range(2))

    @jax.jit
    def value(gates):
        weight = spectral.weights(spec, gates, step_of(0), 10)
        return weighted_sum(spectral.terms(spec, weight, render, truth))

    slope_of = jax.jit(jax.grad(value))
    for logit in (-9.0, -3.0, 0.0, 3.0, 30.0):
        gates = Gates(jnp.asarray(logit), jnp.asarray(logit))
        grad = slope_of(gates)
        share = 1 / (1 + math.exp(-logit))
        rate = 0.1 * share * (1 - share)
        unweighted = (
            wavelet_loss(spec.wavelet, render, truth),
            fourier_loss(spec.fourier, render, truth),
        )
        for part, size in zip(grad, unweighted, strict=True):
            assert part >= 0
            assert float(part) == pytest.approx(
                rate * float(size), rel=1e-12, abs=1e-15
            )
        if logit < 30:  # where the sigmoid is one to rounding nothing is left
            assert min(grad) > 0
            assert gradients.directional_error(value, gates) < 1e-6


@functools.partial(jax.jit, static_argnums=0)
def opening(spec, logit):
    def weight(logit):
        return spectral.weights(spec, Gates(logit, logit), step_of(0), 10).wavelet

    return jax.value_and_grad(weight)(logit)


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    ("gate", "least"), [("learned", 1e-4), ("floor", 0.05)], ids=["learned", "floor"]
)
@pytest.mark.parametrize("logit", [-1e4, -200.0, -30.0])
def test_a_shut_gate_keeps_its_least_opening_and_a_finite_slope(
    gate, least, logit, dtype
):
    spec = SpectralSpec(WaveletSpec(1.0), FourierSpec(1.0), gate=gate)

    value, grad = opening(spec, np.asarray(logit, dtype))
    assert float(value) == pytest.approx(least, rel=1e-6)
    assert 0 <= float(grad) < 1e-12


def test_a_schedule_falls_along_half_a_cosine_to_exactly_nothing():
    spec = SpectralSpec(WaveletSpec(1.0), None, gate="schedule", after=20)
    at = [0, 19, 20, 40, 60, 100, 200]
    got = [float(spectral.weights(spec, None, step_of(i), 100).wavelet) for i in at]
    exact = [
        0,
        0,
        0.5,
        *(0.25 * (1 + math.cos(math.pi * t)) for t in (0.25, 0.5)),
        0,
        0,
    ]
    np.testing.assert_allclose(got, exact, atol=1e-7)
    assert got[0] == got[1] == got[5] == got[6] == 0
    assert spectral.weights(spec, None, step_of(30), 100).fourier is None


def shot_of(render, truth, valid=None):
    render, truth = jnp.asarray(render), jnp.asarray(truth)
    flat = jnp.zeros(render.shape[:2], render.dtype)
    return Observation(Rendering(render, flat, flat), truth, valid, None)


@pytest.mark.parametrize("gate", spectral.GATES)
def test_the_effect_weighs_logs_and_trains_what_its_gate_has(gate, rng):
    spec = SpectralSpec(gate=gate, after=3)
    filled_in = spectral.effect(spec, 10)
    learned = gate in spectral.LEARNED
    assert (filled_in.init is not None) == learned
    assert (filled_in.learning_rate is not None) == learned
    nets = {"spectral": filled_in.init(jax.random.key(0))} if learned else {}
    params = Params({}, nets)
    shot = shot_of(*(picture(rng, 6, 6, "float32") for _ in range(2)))

    def value(params, step):
        context = PenaltyContext(None, step, None, params, observation=shot)
        terms = filled_in.penalty(params.nets.get("spectral"), context)
        return weighted_sum(terms), values(terms)

    both = jax.jit(jax.value_and_grad(value, has_aux=True))
    (early, _), grad = both(params, step_of(2))
    assert float(early) == 0
    assert not any(map(float, jax.tree.leaves(grad)))
    (later, metrics), grad = both(params, step_of(3))
    assert all(float(part) > 0 for part in jax.tree.leaves(grad))
    by_hand = sum(
        float(metrics[f"{name}_weight"]) * float(metrics[name])
        for name in ("wavelet", "fourier")
    )
    assert float(later) == pytest.approx(by_hand, rel=1e-6)
    np.testing.assert_allclose(metrics["wavelet_weight"], 0.05, rtol=1e-6)
    if learned:
        np.testing.assert_allclose(filled_in.learning_rate(step_of(5)), 1e-2)


@pytest.mark.full
def test_the_scenes_optimiser_shuts_a_learned_gate_down_to_its_least(rng):
    spec = SpectralSpec(learning_rate=1.0)
    made = spectral.effect(spec, 10)
    shot = shot_of(*(picture(rng, 4, 4, "float32") for _ in range(2)))
    optimiser = scale_by_row_adam()
    params = Params({}, {"spectral": made.init(jax.random.key(0))})

    @jax.jit
    def update(state, step):
        params, moments = state

        def value(params):
            context = PenaltyContext(None, step, None, params, observation=shot)
            terms = made.penalty(params.nets["spectral"], context)
            return weighted_sum(terms), terms["wavelet_weight"].value

        grads, weight = jax.grad(value, has_aux=True)(params)
        along, moments = optimiser.update(grads, moments, params)
        rate = Params({}, {"spectral": made.learning_rate(step)})
        return (apply_updates(params, along, rate), moments), weight

    state = params, optimiser.init(params)
    _, seen = jax.lax.scan(update, state, jnp.arange(200))
    assert np.all(np.diff(seen) <= 0)
    assert seen[1] < 0.9 * seen[0]
    np.testing.assert_allclose(seen[-1], 0.1 * spectral.LEAST_OPENING, rtol=1e-6)


@pytest.mark.parametrize("absent", ["wavelet", "fourier"])
def test_an_absent_loss_has_no_gate_no_metric_and_no_operation(absent, rng):
    spec = dataclasses.replace(SpectralSpec(), **{absent: None})
    made = spectral.effect(spec, 10)
    nets = {"spectral": made.init(jax.random.key(0))}
    assert getattr(nets["spectral"], absent) is None
    shot = shot_of(*(picture(rng, 6, 6, "float32") for _ in range(2)))
    context = PenaltyContext(None, step_of(1), None, None, observation=shot)
    terms = made.penalty(nets["spectral"], context)
    other = {"wavelet": "fourier", "fourier": "wavelet"}[absent]
    assert set(terms) == {other, f"{other}_weight"}
    text = str(
        jax.make_jaxpr(lambda gates: values(made.penalty(gates, context)))(
            nets["spectral"]
        )
    )
    assert ("fft[" in text) == (absent == "wavelet")
