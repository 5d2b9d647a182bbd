"""Weights and samples along a ray: what they keep and cannot depend on.

Bounds count roundings. A weight is the exponential of a sum of n depths, each rounded,
times a number below one: the derivative of exp(-x) is nowhere more than 1 / x, so a
weight is off by n eps, whatever the depths.
"""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerfies_jax.radiance import compositing, sampling
from tests.hard_cases import properties
from tests.hard_cases.properties import cast, close, compiled, eps, same

pytestmark = pytest.mark.full
SAMPLES = 8
DEPTHS, DISTANCES = properties.optical_depths(), properties.distances()


weights = compiled(compositing.weights)
SUM = 4 * SAMPLES  # eps: n roundings of the sum of depths, n of the sum of weights


@given(depth=DEPTHS, empty=st.integers(0, SAMPLES))
def test_weights_are_shares_of_the_light(depth, empty, dtype):
    """Not negative, at most one in all, what is left is exp of minus the whole depth.

    Empty samples, anywhere, weigh nothing and change nothing.
    """
    found = np.asarray(weights(cast(dtype, depth)), np.float64)
    depth = np.asarray(cast(dtype, depth), np.float64)
    assert np.all(found >= 0)
    assert found.sum() <= 1 + SUM * eps(dtype)
    close(found.sum(), -np.expm1(-depth.sum()), SUM * eps(dtype))
    more = np.insert(np.append(depth, np.zeros(SAMPLES - 1)), empty, 0.0)
    among = np.asarray(weights(cast(dtype, more)), np.float64)
    # other lengths are summed in another order
    close(np.delete(among, empty)[:SAMPLES], found, SUM * eps(dtype))
    same(np.delete(among, empty)[SAMPLES:], np.zeros(SAMPLES - 1))
    assert among[empty] == 0


stratified = compiled(sampling.stratified, static_argnums=(3, 4))
from_weights = compiled(sampling.from_weights, static_argnums=3)
refine = compiled(sampling.refine, static_argnums=3)
SEEDS = st.integers(0, 2**31 - 1)
ANY_WEIGHT = st.one_of(
    properties.magnitudes(1e-44, 1e-30), properties.magnitudes(1e-30, 1e30)
)


@pytest.mark.parametrize("ratio", [1.0, 1 + 1e-6, 10.0, 1e4, 1e7, 1e12])
def test_the_last_sample_in_disparity_is_the_far_end(ratio, dtype):
    """Written 1 / near + (1 / far - 1 / near) share it was 18 % short at 1e7 nears."""
    near, far = cast(dtype, np.array(1e-3), np.array(1e-3 * ratio))
    found = np.asarray(stratified(None, near, far, 64, "disparity"), np.float64)
    share = np.linspace(0, 1, 64)
    low, high = float(near), float(far)
    exact = 1 / ((1 - share) / low + share / high)
    # share is rounded, and 1 - share magnifies that up to 63 times before the last
    close(found, exact, 64 * eps(dtype) * exact)
    assert np.all(np.diff(found) >= 0)


@given(
    seed=SEEDS,
    edges=DISTANCES,
    weight=st.lists(ANY_WEIGHT, min_size=SAMPLES - 1, max_size=SAMPLES - 1),
    power=st.integers(-30, 30),
)
def test_fine_samples_are_sorted_in_range_and_where_weights_are(
    seed, edges, weight, power, dtype
):
    """For any weights; and a common factor of all weights does not matter."""
    edges, weight = cast(dtype, edges, np.array(weight))
    key = jax.random.key(seed)
    found = from_weights(key, edges, weight, 16)
    assert np.all(np.diff(found) >= 0)
    assert np.all((found >= edges[0]) & (found <= edges[-1]))
    largest = float(weight.max())
    tiny = float(np.finfo(dtype).tiny)
    scaled = weight * weight.dtype.type(2.0**power)
    if min(largest, largest * 2.0**power) > tiny and np.all(
        (scaled > tiny) | (weight == 0)
    ):
        same(from_weights(key, edges, scaled, 16), found)
    all_ = refine(key, edges, np.append(weight, weight[-1]), 16)
    assert np.all(np.diff(all_) >= 0)
    assert np.all(np.isin(edges, all_))
