"""Samples along a ray against NumPy loops and the Nerfies code's values."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields import sampling
from tests import gradients

# Compiled once for each precision and shape: operation by operation the suite would
# take five times as long.
stratified = jax.jit(sampling.stratified, static_argnums=(3, 4))
sample_pdf = jax.jit(sampling.sample_pdf, static_argnums=(3, 4))
among = jax.jit(sampling.among, static_argnums=(4, 5))
refine = jax.jit(sampling.refine, static_argnums=(3, 4))


@functools.partial(jax.jit, static_argnums=3)
def sample_many_pdfs(key, edges, weights, count):
    """One row of weights after another, all with the same key."""
    return jax.vmap(lambda w: sampling.sample_pdf(key, edges, w, count))(weights)


def bisect_inverse(edges, weights, shares):
    """Inverse of the cumulated weights by bisection on its integral, in float64."""
    edges, weights = np.asarray(edges, np.float64), np.asarray(weights, np.float64)
    heights = weights / np.diff(edges)

    def integral(x):
        return np.sum(heights * np.clip(x - edges[:-1], 0, np.diff(edges)))

    samples = []
    for share in shares:
        low, high = edges[0], edges[-1]
        for _ in range(60):
            middle = (low + high) / 2
            if integral(middle) < share * weights.sum():
                low = middle
            else:
                high = middle
        samples.append(high)
    return np.array(samples)


@functools.cache
def key(seed):
    return jax.random.key(seed)


@functools.cache
def keys():
    return jax.jit(jax.random.split, static_argnums=1)(key(3), 200)


@pytest.mark.parametrize("spacing", sampling.SPACINGS)
def test_even_distances_are_even(spacing, dtype):
    near, far = np.asarray(0.3, dtype), np.asarray(7.0, dtype)
    got = stratified(None, near, far, 9, spacing)
    assert got.dtype == dtype
    low, high = float(near), float(far)
    steps = (
        [low + (high - low) * i / 8 for i in range(9)]
        if spacing == "linear"
        else [8 / ((8 - i) / low + i / high) for i in range(9)]
    )
    np.testing.assert_allclose(got, steps, {"float32": 5e-7, "float64": 1e-15}[dtype])
    assert got[0] == near
    assert got[-1] == far


@pytest.mark.parametrize("spacing", sampling.SPACINGS)
def test_jittered_distances_fill_their_bins(spacing, dtype):
    near, far = np.asarray(0.5, dtype), np.asarray(3.0, dtype)
    even = np.asarray(stratified(None, near, far, 6, spacing))
    halfway = (even[1:] + even[:-1]) / 2
    lower, upper = np.append(near, halfway), np.append(halfway, far)
    many = jax.jit(
        jax.vmap(sampling.stratified, (0, *[None] * 4)), static_argnums=(3, 4)
    )
    got = np.asarray(many(keys(), near, far, 6, spacing))
    ulp = 1e-6
    assert np.all(got >= lower - ulp)
    assert np.all(got <= upper + ulp)
    assert np.all(np.diff(got, axis=1) >= 0)
    within = (got - lower) / (upper - lower)
    # uniform: mean 1/2 (5 standard errors of 0.29 / sqrt(200)), both ends visited
    assert np.all(np.abs(within.mean(0) - 0.5) < 0.11)
    assert np.all(within.min(0) < 0.1)
    assert np.all(within.max(0) > 0.9)


@pytest.mark.hard_cases
@pytest.mark.parametrize("spacing", sampling.SPACINGS)
def test_distances_never_step_back_however_short_the_ray(spacing, dtype):
    near = np.asarray(0.7, dtype)
    for gap in (0.0, 1e-7, 1e-6, 1e-3, -0.5):
        far = np.asarray(near * np.asarray(1 + gap, dtype))
        for seed in range(3):
            got = np.asarray(stratified(key(seed), near, far, 64, spacing))
            assert np.all(np.diff(got) >= 0)
            assert np.all(got <= float(far))
            assert gap < 0 or np.all(got >= float(near))


@pytest.mark.hard_cases
@pytest.mark.parametrize("ratio", [1.0, 1 + 1e-6, 1e4, 1e7, 1e12])
def test_the_last_sample_in_disparity_is_the_far_end(ratio, dtype):
    """Written 1 / near + (1 / far - 1 / near) share it was 18 % short at 1e7 nears."""
    near, far = np.asarray(1e-3, dtype), np.asarray(1e-3 * ratio, dtype)
    samples = np.asarray(stratified(None, near, far, 64, "disparity"), np.float64)
    share = np.linspace(0, 1, 64)
    exact = 1 / ((1 - share) / float(near) + share / float(far))
    # share is rounded, and 1 - share magnifies that up to 63 times before the last
    np.testing.assert_allclose(samples, exact, rtol=64 * np.finfo(dtype).eps)
    assert np.all(np.diff(samples) >= 0)


def test_samples_in_disparity_are_even_in_normalized_device_coordinates(float64):
    """NeRF's coordinates of forward-facing cameras in a plane (appendix C)."""
    focal, near, far = 1.3, 1.0, 50.0
    direction = np.array([0.2, -0.4, -1.0])  # cameras look along -z
    length = np.linalg.norm(direction)
    distance = stratified(None, near * length, far * length, 33, "disparity")
    x, y, z = ([0.3, -0.2, 0.0] + np.asarray(distance)[:, None] * direction / length).T
    device = np.stack([-focal * x / z, -focal * y / z, 1 + 2 * near / z], axis=1)
    even = np.linspace(device[0], device[-1], 33)
    np.testing.assert_allclose(device, even, atol=1e-12)
    np.testing.assert_allclose(device[[0, -1], 2], [-1, 1 - 2 * near / far], atol=1e-12)


def test_distances_follow_near_and_far(float64):
    key = jax.random.key(2)

    def total(near, far):
        return sum(
            jnp.sum(jnp.sin(3 * sampling.stratified(key, near, far, 7, spacing)))
            for spacing in sampling.SPACINGS
        )

    assert gradients.directional_error(total, np.float64(0.3), np.float64(1.7)) < 1e-8


def test_inverse_is_the_bisected_one(dtype, rng):
    edges = np.sort(rng.uniform(1, 3, 13))
    weights = rng.uniform(0.1, 1, 12)
    got = sample_pdf(None, edges.astype(dtype), weights.astype(dtype), 31)
    wanted = bisect_inverse(edges, weights, np.linspace(0, 1, 31))
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(got, wanted, atol=tolerance)


def test_one_sample_without_a_key_halves_the_weight(dtype, rng):
    edges, weights = np.sort(rng.uniform(1, 3, 13)), rng.uniform(0.1, 1, 12)
    got = sample_pdf(None, edges.astype(dtype), weights.astype(dtype), 1)
    wanted = bisect_inverse(edges, weights, [0.5])
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(got, wanted, atol=tolerance)


HARD = {
    "nothing": np.zeros(16),
    "1e-31": np.full(16, 1e-31),
    "1e-37 and less": np.append(np.full(8, 1e-37), np.full(8, 1e-40)),
    "subnormal": np.full(16, 1e-42),
    "one hot": np.eye(16)[5],
    "faint one hot": np.eye(16)[5] * 1e-30,
    "first": np.eye(16)[0],
    "last": np.eye(16)[15],
    "two peaks": np.eye(16)[2] + np.eye(16)[12],
    "huge": np.full(16, 3e38),  # 1 / 3e38 is no normal number
    "huge one hot": np.eye(16)[5] * 3e38,
}


EDGES = np.linspace(2, 4, 17)


@pytest.mark.hard_cases
def test_weights_of_any_size_share_alike_and_peaks_draw_all(dtype):
    """But the ends u = 0 and 1 of the even shares, which are the ends of the range."""
    weights = np.stack(list(HARD.values())).astype(dtype)
    draws = [
        np.asarray(sample_many_pdfs(random, EDGES.astype(dtype), weights, 34))
        for random in (None, key(1))
    ]
    # 16 floors of one rounding unit on a sum of one, on bins of 1/8
    tolerance = {"float32": 3e-6, "float64": 1e-13}[dtype]
    for case, inputs, even, random in zip(HARD, HARD.values(), *draws, strict=True):
        for got in (even, random):
            assert got.dtype == dtype
            assert np.all((got >= 2) & (got <= 4)), case  # and so finite
            assert np.all(np.diff(got) >= 0), case
        if case in ("nothing", "1e-31", "subnormal", "huge"):
            close = {"float32": 5e-7, "float64": 1e-15}[dtype]
            np.testing.assert_allclose(even, np.linspace(2, 4, 34), rtol=close)
        elif case != "1e-37 and less":
            wanted = bisect_inverse(EDGES, inputs, np.linspace(0, 1, 34))
            np.testing.assert_allclose(even[1:-1], wanted[1:-1], atol=tolerance)
            bins = np.clip(np.searchsorted(EDGES, random, side="right") - 1, 0, 15)
            assert np.all(inputs[bins] > 0), case


@pytest.mark.hard_cases
@pytest.mark.full
def test_thousands_of_bins_stay_in_range(dtype, rng):
    """cdf[-1] is 1 only to 1e-7 and sums in a tree may step back."""
    weights = (rng.uniform(0, 1, 4096) ** 8).astype(dtype)
    edges = np.linspace(0, 1, 4097).astype(dtype)
    got = np.asarray(sample_pdf(None, edges, weights, 4096))  # both ends among them
    assert np.all(np.diff(got) >= 0)
    assert (got.min() >= 0) & (got.max() <= 1)
    assert got.max() > 0.99


def test_random_shares_are_stratified_and_unbiased(dtype, rng):
    weights = rng.uniform(0, 1, 8)
    edges = np.linspace(0, 1, 9)
    many = jax.jit(
        jax.vmap(sampling.sample_pdf, (0, None, None, None)), static_argnums=3
    )
    got = many(keys(), edges.astype(dtype), weights.astype(dtype), 25)
    got = np.asarray(got, np.float64)
    # back through the cumulated weights: one share in each 25th of [0, 1]
    shares = np.interp(got, edges, np.append(0, np.cumsum(weights)) / weights.sum())
    lower = np.arange(25) / 25
    assert np.all(shares >= lower - 1e-5)
    assert np.all(shares <= lower + 1 / 25 + 1e-5)
    within = (shares - lower) * 25
    assert np.all(np.abs(within.mean(0) - 0.5) < 0.11)


def test_filled_bins_get_their_share_of_the_samples(dtype, rng):
    filled, near, far = rng.random(8) < 0.4, 2.0, 6.0
    assert 1 < filled.sum() < 7
    ends = jnp.asarray(near, dtype), jnp.asarray(far, dtype)
    got = among(None, *ends, jnp.asarray(filled), 4001, 0.1)
    assert (np.diff(got) >= 0).all()
    assert (got[0], got[-1]) == ends
    counts = np.histogram(np.asarray(got, np.float64), 8, (near, far))[0]
    wanted = np.where(filled, 1, 0.1)
    np.testing.assert_allclose(counts, 4001 * wanted / wanted.sum(), atol=2)


@pytest.mark.hard_cases
@pytest.mark.parametrize("filled", [False, True])
@pytest.mark.parametrize("far", [2.0, 2.5, 1e6])
def test_samples_are_even_where_nothing_tells_bins_apart(filled, far, dtype):
    ends = jnp.asarray(2, dtype), jnp.asarray(far, dtype)
    got = among(None, *ends, jnp.full(64, filled), 9, 0.05)
    np.testing.assert_allclose(got, np.linspace(2, far, 9), rtol=1e-6)


@pytest.mark.hard_cases
def test_no_gradient_passes_through_the_samples(dtype, rng):
    edges, weights = np.linspace(0, 1, 9), rng.uniform(0, 1, 8)
    edges, weights = edges.astype(dtype), weights.astype(dtype)
    along = jnp.asarray(np.linspace(1, 2, 8), dtype)

    def total(edges, weights):
        distances = sampling.sample_pdf(jax.random.key(0), edges, weights, 7)
        return jnp.sum(distances) + jnp.sum(sampling.refine(None, along, weights, 6))

    for grad in jax.jit(jax.grad(total, argnums=(0, 1)))(edges, weights):
        np.testing.assert_array_equal(grad, 0)


@pytest.mark.hard_cases
def test_union_keeps_all_and_their_gradients(dtype):
    coarse = np.asarray([1.0, 2.0, 3.0], dtype)
    fine = np.asarray([0.5, 2.0, 2.5], dtype)  # one tie

    def squares(coarse, fine):
        union = sampling.union(coarse, fine)
        return jnp.sum(union**2), union

    (by_coarse, by_fine), union = jax.jit(jax.grad(squares, (0, 1), has_aux=True))(
        coarse, fine
    )
    np.testing.assert_array_equal(union, np.asarray([0.5, 1, 2, 2, 2.5, 3]))
    np.testing.assert_array_equal(by_coarse, 2 * coarse)
    np.testing.assert_array_equal(by_fine, 2 * fine)


def test_refine_asks_more_where_light_stops(dtype):
    distances, weights = np.linspace(1, 2, 11).astype(dtype), np.zeros(11, dtype)
    weights[4], weights[10] = 0.7, 0.3  # the last: behind
    new = np.asarray(refine(key(0), distances, weights, 20))
    assert new.shape == (20,)
    assert np.all(np.diff(new) >= 0)
    assert np.all((new > 1.35 - 1e-6) & (new < 1.45 + 1e-6))


@pytest.mark.full
@pytest.mark.hard_cases
@pytest.mark.parametrize("narrow", [jnp.bfloat16, jnp.float16])
def test_narrow_rays_keep_their_order_and_their_peaks(narrow):
    near, far = np.asarray(2, narrow), np.asarray(4, narrow)
    even = stratified(key(0), near, far, 64, "linear")
    edges = np.linspace(2, 4, 65).astype(narrow)
    peak = (np.arange(64) == 40).astype(narrow)
    # A rounding unit of bfloat16 in each of 64 bins would be a third of the weight.
    random = sample_pdf(key(0), edges, peak, 64)
    for samples in (even, random):
        assert samples.dtype == narrow
        samples = np.asarray(samples, np.float64)
        assert np.all(np.diff(samples) >= 0)
        assert np.all((samples >= 2) & (samples <= 4))
    assert np.all((samples >= float(edges[40])) & (samples <= float(edges[41])))


@pytest.mark.hard_cases
def test_a_weight_that_is_not_a_number_shows(dtype):
    """Nothing is drawn from it as if it were one."""
    weights = np.where(np.arange(8) == 3, np.nan, 1).astype(dtype)
    edges = np.linspace(2, 4, 9).astype(dtype)
    assert np.isnan(sample_pdf(None, edges, weights, 9)).any()


@pytest.mark.parametrize("near", [0.0, 2.5])
def test_centered_samples_have_the_density_of_the_documentation(near, dtype):
    ends = (jnp.asarray(value, dtype) for value in (near, 40.0, 3.0, 0.5))
    start, far, middle, width = ends

    def at(key):
        return sampling.sample_around(key, start, far, 33, middle, width)

    even = np.asarray(at(None), float)
    # Equal integrals of the density between neighbors.
    away = np.abs(even - 3)
    integral = np.sign(even - 3) * (1 / 0.5 - 1 / (0.5 + away))
    np.testing.assert_allclose(np.diff(integral), np.diff(integral).mean(), rtol=2e-3)
    np.testing.assert_allclose(even[[0, -1]], [near, 40], rtol=1e-4, atol=1e-5)
    assert np.mean(np.abs(even - 3) <= 0.5) > 0.45
    jittered = at(jax.random.key(0))
    assert jittered.dtype == dtype
    assert (np.diff(jittered) >= 0).all()
    assert jittered.min() >= near
    assert jittered.max() <= 40
