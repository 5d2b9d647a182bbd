"""Compositing against mpmath loops, the Nerfies code's values and closed forms."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from nerfies_jax.fields import compositing
from nerfies_jax.fields.compositing import AT_INFINITY, EMPTY_BELOW
from tests import gradients

# Compiled once for each precision and shape, which is much quicker than by operation.
weights_of = jax.jit(compositing.weights)
many_weights = jax.jit(jax.vmap(compositing.weights))
media_weights_of = jax.jit(compositing.media_weights)
composite_media = jax.jit(compositing.composite_media)
scale_opacity = jax.jit(compositing.scale_opacity)
median_indices = jax.jit(jax.vmap(compositing.median_index))


RELATIVE = {"float32": 1e-6, "float64": 1e-14}


def exact_weights(optical_depth):
    """Sample by sample, media as rows, with 50 digits."""
    with mpmath.workdps(50):
        depth = [[mpmath.mpf(float(d)) for d in row] for row in optical_depth]
        reaching, rows = mpmath.mpf(1), [[] for _ in depth]
        for sample in range(len(depth[0])):
            for row, medium in zip(rows, depth, strict=True):
                row.append(float(reaching * (1 - mpmath.exp(-medium[sample]))))
            for medium in depth:
                reaching *= mpmath.exp(-medium[sample])
    return np.array(rows)


def exact_scale_opacity(depth, logit):
    with mpmath.workdps(60 + int(abs(logit))):
        share = 1 / (1 + mpmath.exp(-mpmath.mpf(float(logit))))
        opacity = 1 - mpmath.exp(-mpmath.mpf(float(depth)))
        return float(-mpmath.log(1 - share * opacity))


@pytest.mark.hard_cases
@pytest.mark.parametrize("level", [1e-8, 1e-4, 1.0, 30.0, 1e3])
def test_weights_are_exact_from_thin_air_to_walls(level, dtype, rng):
    depth = (rng.uniform(0.5, 1.5, 40) * level).astype(dtype)
    exact = exact_weights(depth[None])[0]
    # relative where float32 can hold the number; depths add up errors of their own size
    tolerance = RELATIVE[dtype] * (1 + np.cumsum(depth))
    shown = exact > 1e-30
    got = np.asarray(weights_of(depth), np.float64)
    assert np.all(np.abs(got / np.where(shown, exact, 1) - 1)[shown] < tolerance[shown])
    assert np.all(got[~shown] < 2e-30)


@pytest.mark.hard_cases
@pytest.mark.parametrize("case", ["walls", "mixed", "infinite last", "one wall"])
def test_weights_never_sum_to_more_than_one(case, dtype, rng):
    depth = {
        "walls": rng.uniform(0, 50, (256, 64)),
        "mixed": 10 ** rng.uniform(-8, 3, (256, 64)),
        "infinite last": np.concatenate(
            [rng.uniform(0, 0.2, (256, 63)), np.full((256, 1), 1e10)], axis=1
        ),
        "one wall": np.tile(np.eye(64) * 1e10, (4, 1)),
    }[case]
    total = np.sum(many_weights(depth.astype(dtype)), axis=1)
    assert total.dtype == dtype
    assert np.max(total) <= 1 + 1e-6
    if case in ("infinite last", "one wall"):
        assert np.min(total) >= 1 - 1e-6


@jax.jit
def weights_and_slopes(density, spacing):
    """Weights, and their slopes in each of the densities."""

    def weights(density):
        return compositing.weights(density * spacing)

    return weights(density), jax.jacrev(weights)(density)


@pytest.mark.hard_cases
def test_infinite_spacing_and_depth_have_finite_values_and_slopes(dtype):
    spacing = np.asarray([1.0, 2.0, 4.0, 1e10], dtype)
    for density in (0.0, 1e-12, 1.0, 1e6):
        results = weights_and_slopes(np.full(4, density, dtype), spacing)
        assert all(np.all(np.isfinite(leaf)) for leaf in results)
    depth = np.asarray([0.1, np.inf, 1.0, np.inf], dtype)
    weights, grads = weights_and_slopes(depth, np.ones(4, dtype))
    np.testing.assert_allclose(weights, [1 - np.exp(-0.1), np.exp(-0.1), 0, 0], 1e-6)
    assert np.all(np.isfinite(grads))


def test_weights_and_opacities_have_the_slopes_of_central_differences(float64, rng):
    cotangent, logit = jnp.asarray(rng.normal(size=12)), rng.normal(size=12)

    def total(depth, logit):
        thin = jnp.sum(jnp.sin(compositing.scale_opacity(depth, logit)))
        return jnp.vdot(compositing.weights(depth), cotangent) + thin

    assert gradients.directional_error(total, rng.uniform(0, 1, 12), logit) < 1e-7


@pytest.mark.hard_cases
@pytest.mark.parametrize("level", [1e-8, 1.0, 30.0])
def test_media_share_their_transmittance(level, dtype, rng):
    depth = (rng.uniform(0.1, 1, (3, 16)) * level).astype(dtype)
    exact = exact_weights(depth)
    got = np.asarray(media_weights_of(depth), np.float64)
    tolerance = RELATIVE[dtype] * (1 + np.cumsum(np.sum(depth, axis=0)))
    assert np.all(np.abs(got - exact) <= tolerance * exact + 1e-35)


def test_media_composite_term_by_term(float64, rng):
    depth = rng.uniform(0, 0.3, (2, 9))
    colors, background = rng.uniform(size=(2, 9, 3)), rng.uniform(size=3)
    distances = np.sort(rng.uniform(1, 2, 9))
    seen = composite_media(depth, colors, distances, background)
    passed = np.exp(-depth.sum())
    color = passed * background
    for medium, weights in enumerate(exact_weights(depth)):
        for sample, weight in enumerate(weights):
            color = color + weight * colors[medium, sample]
    np.testing.assert_allclose(seen.color, color, rtol=1e-13)
    assert abs(float(seen.alpha) - (1 - passed)) < 1e-14
    joint = exact_weights(depth.sum(0)[None])[0]
    assert abs(float(seen.distance) - joint @ distances / joint.sum()) < 1e-13


@pytest.mark.hard_cases
def test_scale_opacity_keeps_its_digits_at_any_opacity(dtype):
    """XLA's log1p of float64 loses 120 eps about -0.41."""
    depth, logit = np.meshgrid([0.3, 1.0, 8.0], np.linspace(-2, 2, 41))
    depth, logit = depth.astype(dtype).ravel(), logit.astype(dtype).ravel()
    exact = [exact_scale_opacity(*pair) for pair in zip(depth, logit, strict=True)]
    thin = np.asarray(scale_opacity(depth, logit), np.float64)
    # twice what was measured
    np.testing.assert_allclose(thin, exact, rtol=6 * np.finfo(dtype).eps)


def test_intervals_end_as_told(dtype):
    distances, intervals = np.asarray([0.5, 0.75, 1.75], dtype), compositing.intervals
    for last in (AT_INFINITY, 0.25):
        got = jax.jit(intervals)(distances, np.asarray(last, dtype))
        assert got.dtype == dtype
        np.testing.assert_array_equal(got, np.asarray([0.25, 1, last], dtype))


def scene(dtype, samples=6):
    colors = np.linspace(0.1, 0.9, 3 * samples).reshape(-1, 3).astype(dtype)
    return colors, np.linspace(2.0, 4.5, samples).astype(dtype)


@jax.jit
def seen_and_slope(weights, colors, distances, background):
    """The composite, and the slope of its depth in the weights."""

    def depth(weights):
        seen = compositing.composite(weights, colors, distances, background)
        return seen.distance, seen

    grad, seen = jax.grad(depth, has_aux=True)(weights)
    return seen, grad


@pytest.mark.hard_cases
def test_an_empty_ray_is_background_at_its_far_end(dtype):
    colors, distances = scene(dtype)
    background = np.asarray([1.0, 0.5, 0.25], dtype)
    for scale in (0.0, 1e-38, 1e-20, 1e-8):
        weights = (scale * np.array([0.0, 1, 0, 2, 0, 0])).astype(dtype)
        seen, grads = seen_and_slope(weights, colors, distances, background)
        np.testing.assert_allclose(seen.color, background, atol=1e-7)
        assert abs(float(seen.distance) - 4.5) < 1e-4
        assert float(seen.median_distance) == 4.5
        assert np.all(np.abs(grads) <= 4.5 / EMPTY_BELOW)
    # Continuous where the far end comes in, and between the two beyond
    for alpha, wanted, close in (
        (1.0, 2.5, 1e-6),
        (EMPTY_BELOW * 1.0001, 2.5, 1e-6),
        (EMPTY_BELOW * 0.9999, 2.5, 3e-4),
        (EMPTY_BELOW / 2, 3.5, 1e-5),
    ):
        weights = (alpha * np.eye(6)[1]).astype(dtype)
        seen, _ = seen_and_slope(weights, colors, distances, background)
        assert abs(float(seen.distance) - wanted) < close


@pytest.mark.hard_cases
def test_median_is_the_first_sample_past_half(dtype, rng):
    weights = rng.dirichlet(np.ones(9), size=50) * rng.uniform(0.3, 1, (50, 1))
    got = median_indices(weights.astype(dtype))
    past = np.cumsum(weights, axis=1) >= 0.5
    wanted = np.where(past.any(1), np.argmax(past, axis=1), 8)
    np.testing.assert_array_equal(got, wanted)


def test_composites_have_the_slopes_of_central_differences(float64, rng):
    """On white and on nothing, and the distance of a faint ray."""
    white, nowhere = jnp.asarray([1.0, 0.9, 0.8]), None
    faint = jnp.asarray(rng.uniform(0, 1e-4, 8))

    def loss(depth, colors, distances, scale):
        weights, total = compositing.weights(depth), 0.0
        for behind in (white, nowhere):
            seen = compositing.composite(weights, colors, distances, behind)
            total += jnp.sum(jnp.sin(3 * seen.color))
            total += seen.alpha**2 + seen.distance**2
        far = distances[-1]
        return total + compositing.expected_distance(scale * faint, distances, far)

    inputs = rng.uniform(0.05, 0.4, 8), rng.uniform(size=(8, 3))
    distances = np.sort(rng.uniform(1, 2, 8))
    error = gradients.directional_error(loss, *inputs, distances, np.float64(1))
    assert error < 1e-7


@pytest.mark.full
@pytest.mark.hard_cases
@pytest.mark.parametrize("narrow", [jnp.bfloat16, jnp.float16])
def test_narrow_depths_are_summed_in_float32(narrow, rng):
    """A running sum of 128 depths in bfloat16 loses a hundredth of the light."""
    depth = rng.uniform(0, 0.1, 128).astype(narrow)
    exact = exact_weights(np.asarray(depth, np.float64)[None])[0]
    weights = weights_of(depth)
    joint = media_weights_of(np.stack([depth, depth]) / narrow(2))
    assert weights.dtype == joint.dtype == narrow
    unit = float(jnp.finfo(narrow).eps)
    near = {"rtol": unit, "atol": 2.0**-24}  # of which float16 has no less
    np.testing.assert_allclose(np.asarray(weights, np.float64), exact, **near)
    both = np.sum(np.asarray(joint, np.float64), axis=0)
    # Two halves of the opacity of one sample overlap.
    wanted = exact * 2 * -np.expm1(-np.asarray(depth, np.float64) / 2)
    wanted /= -np.expm1(-np.asarray(depth, np.float64))
    np.testing.assert_allclose(both, wanted, **near)
    middle = np.searchsorted(np.cumsum(exact), 0.5)
    assert abs(int(median_indices(weights[None])[0]) - middle) <= 1
