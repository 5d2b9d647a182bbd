"""Each term by itself: closed forms, slopes, and what has none or too much of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.effects import scene_flow_losses as flow_losses
from tests import gradients

weighted_mean = jax.jit(jax.value_and_grad(flow_losses.weighted_mean))
entropy = jax.jit(jax.value_and_grad(flow_losses.entropy))
normalised_depth = jax.jit(jax.value_and_grad(flow_losses.normalised_depth))
settle = jax.jit(flow_losses.settle)


@pytest.mark.hard_cases
def test_a_weighted_mean_of_nothing_is_zero_with_a_slope_of_zero(dtype):
    values, weight = np.ones((3, 2), dtype), np.zeros(3, dtype)
    value, grad = weighted_mean(values, weight)
    assert float(value) == 0
    assert (np.asarray(grad) == 0).all()


@pytest.mark.hard_cases
@pytest.mark.parametrize("size", [1e-12, 1e38])
def test_weights_count_alike_whatever_their_size(size, dtype):
    """1e-8 added to small ones would leave 2e-3; 1 / 3e38 is no normal number."""
    values = np.asarray([[1.0, 3.0], [5.0, 7.0], [9.0, 9.0]], dtype)
    weight = np.asarray([size, 3 * size, 0], dtype)
    value, _ = weighted_mean(values, weight)
    np.testing.assert_allclose(value, 5, rtol=1e-6)


@pytest.mark.full
def test_rays_that_are_not_present_teach_nothing(float64):
    flow = jnp.asarray(np.random.default_rng(0).normal(size=(2, 4, 3)))
    weight = jnp.full((2, 4), 0.2)
    present = jnp.asarray([True, False])
    terms = {
        "cycle": lambda f: flow_losses.cycle(f, 0.3 * f, weight, present),
        "magnitude": lambda f: flow_losses.magnitude(f, weight, present),
        "smoothness": lambda f: flow_losses.smoothness(f, present),
        "kinetic": lambda f: flow_losses.kinetic(f, 0.3 * f, present),
    }
    for name, term in terms.items():
        grad = jax.grad(term)(flow)
        assert (grad[1] == 0).all(), name
        assert (grad[0] != 0).any(), name


def test_closed_forms_of_a_straight_path():
    """Flow (1, 2, 3) s at sample s of 4, there and back; all in one ray."""
    flow = np.arange(4.0)[None, :, None] * np.array([1.0, 2.0, 3.0])
    flow = jnp.asarray(flow, jnp.float32)
    one, weight = jnp.asarray([True]), jnp.full((1, 4), 0.25)
    np.testing.assert_allclose(flow_losses.smoothness(flow, one), 2.0)
    np.testing.assert_allclose(flow_losses.magnitude(flow, weight, one), 3.0)
    assert flow_losses.cycle(flow, -flow, weight, one) == 0
    assert flow_losses.kinetic(flow, -flow, one) == 0
    # half of (2 s)² (1 + 4 + 9) / 3 on average over s
    np.testing.assert_allclose(
        flow_losses.kinetic(flow, flow, one), 0.5 * 14 * 14 / 3, rtol=1e-6
    )


def test_magnitude_sums_samples_not_axes(float64):
    """Opposite flow of two halves of a ray cancels; of two axes it does not."""
    one = jnp.asarray([True])
    along = jnp.asarray([[[1.0, 0, 0], [-1.0, 0, 0]]])
    across = jnp.asarray([[[1.0, -1.0, 0], [1.0, -1.0, 0]]])
    weight = jnp.full((1, 2), 0.5)
    assert flow_losses.magnitude(along, weight, one) == 0
    np.testing.assert_allclose(flow_losses.magnitude(across, weight, one), 2 / 3)


def test_what_moves_does_not_turn_transparent_for_it(float64):
    weight, flow = jnp.full((2, 3), 0.3), jnp.ones((2, 3, 3))
    present = jnp.ones(2, bool)
    grad = jax.grad(lambda w: flow_losses.magnitude(flow, w, present))(weight)
    assert (grad == 0).all()


@pytest.mark.hard_cases
@pytest.mark.parametrize("logit", [-1e4, -100.0, -17.0, 0.0, 17.0, 100.0, 1e4])
def test_entropy_is_finite_however_sure_it_is(dtype, logit):
    value, grad = entropy(np.full((1, 1), logit, dtype))
    share = 1 / (1 + np.exp(-min(max(logit, -600), 600)))
    expected = -share * -np.log1p(np.exp(-min(max(logit, -600), 600)))
    expected = abs(expected)
    np.testing.assert_allclose(value, expected, rtol=1e-5, atol=1e-37)
    assert np.isfinite(grad).all()


@pytest.mark.hard_cases
def test_expected_values_are_weighed_and_what_passes_ends_at_the_last(float64):
    values = np.array([[[1.0], [2.0], [5.0]]])
    weight = np.array([[0.5, 0.2, 0.1]])
    np.testing.assert_allclose(settle(weight, values), 0.9 + 0.5 + 1.0)
    nothing = settle(np.zeros((1, 3)), values)
    np.testing.assert_array_equal(nothing, [[5.0]])


def test_depth_is_compared_up_to_scale_and_offset(dtype):
    depth = jnp.asarray(np.random.default_rng(1).uniform(1, 4, 21), dtype)
    known = jnp.arange(21) != 7
    odd = jnp.where(known, 3 * depth + 2, 1e30)
    assert flow_losses.normalised_depth(depth, odd, known) < 1e-11
    other = flow_losses.normalised_depth(depth, -depth, known)
    offset = np.asarray(depth, np.float64)[np.asarray(known)]
    offset = offset - np.sort(offset)[9]  # the lower of the two middle ones of twenty
    # The negative has its lower middle at the upper one of these: not quite twice.
    flipped = -offset - np.sort(-offset)[9]
    expected = offset / np.abs(offset).mean() - flipped / np.abs(flipped).mean()
    np.testing.assert_allclose(other, np.mean(expected**2), rtol=1e-5)


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    ("depth", "count"),
    [
        ([2.0, 2.0, 2.0, 2.0], 4),  # flat: a deviation of zero
        ([0.0, 0.0, 0.0, 0.0], 4),  # at the camera
        ([2.0, 2.0 + 1e-6, 2.0, 2.0], 4),
        ([1.0, 2.0, 3.0, 4.0], 1),  # one known depth says nothing
        ([1.0, 2.0, 3.0, 4.0], 0),
    ],
)
def test_depths_without_a_spread_stay_finite(dtype, depth, count):
    target = np.asarray([1.0, 3.0, 2.0, 5.0], dtype)
    found = normalised_depth(np.asarray(depth, dtype), target, np.arange(4) < count)
    value, grad = map(np.asarray, found)
    assert np.isfinite(value)
    assert value < 10
    assert np.abs(grad).max() <= 5 / flow_losses.FLATTEST / max(max(depth), 1e-3)
    if count < 2:
        assert value == 0
        assert (grad == 0).all()


def test_slopes_are_those_of_differences(float64):
    rng = np.random.default_rng(3)
    rays, samples = 5, 4
    flow, back = (jnp.asarray(rng.normal(size=(rays, samples, 3))) for _ in "ab")
    seen = jnp.asarray(rng.uniform(0.1, 1, (rays, samples)))
    weight = jnp.asarray(rng.uniform(0, 0.2, (rays, samples)))
    colour, target = (jnp.asarray(rng.uniform(size=(rays, 3))) for _ in "ab")
    depth = jnp.asarray(rng.uniform(1, 5, rays))
    present = jnp.asarray([True, True, False, True, True])
    mask = jnp.where(present, jnp.asarray(rng.uniform(size=rays)), 0)
    cases = {
        "warped": (
            lambda c, s: flow_losses.warped(c, target, weight, s, mask),
            colour,
            seen,
        ),
        "cycle": (
            lambda f, b, s: flow_losses.cycle(f, b, s, present),
            flow,
            back,
            seen,
        ),
        "magnitude": (lambda f: flow_losses.magnitude(f, weight, present), flow),
        "smoothness": (lambda f: flow_losses.smoothness(f, present), flow),
        "kinetic": (lambda f, b: flow_losses.kinetic(f, b, present), flow, back),
        "entropy": (flow_losses.entropy, 4 * seen - 2),
        "settle": (lambda w, f: jnp.sum(flow_losses.settle(w, f) ** 2), weight, flow),
        "depth": (
            lambda d: flow_losses.normalised_depth(d, depth[::-1] ** 2, present),
            depth,
        ),
    }
    for name, (function, *args) in cases.items():
        assert gradients.directional_error(function, *args, step=1e-6) < 1e-6, name
