"""Each term by itself: closed forms, slopes, and what has none or too much of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields.effects import scene_flow_losses as flow_losses
from tests import gradients

entropy = jax.jit(jax.value_and_grad(flow_losses.entropy))
normalized_depth = jax.jit(jax.value_and_grad(flow_losses.normalized_depth))
expected_value = jax.jit(flow_losses.expected_value)


@jax.jit
def of_flow(flow, back, weight):
    """The terms of one ray's flow, and the slope of its magnitude in the weights."""
    one = jnp.asarray([True])
    return {
        "smoothness": flow_losses.smoothness(flow, one),
        "magnitude": flow_losses.magnitude(flow, weight, one),
        "by weight": jax.grad(flow_losses.magnitude, 1)(flow, weight, one),
        "cycle": flow_losses.cycle(flow, back, weight, one),
        "kinetic": flow_losses.kinetic(flow, back, one),
    }


def test_closed_forms_of_a_straight_path():
    """Flow (1, 2, 3) s at sample s of 4, there and back; all in one ray."""
    flow = np.arange(4.0)[None, :, None] * np.array([1.0, 2.0, 3.0])
    flow, weight = flow.astype(np.float32), np.full((1, 4), 0.25, np.float32)
    back, same = (of_flow(flow, sign * flow, weight) for sign in (-1, 1))
    np.testing.assert_allclose(back["smoothness"], 2.0)
    np.testing.assert_allclose(back["magnitude"], 3.0)
    assert back["cycle"] == 0
    assert back["kinetic"] == 0
    # half of (2 s)² (1 + 4 + 9) / 3 on average over s
    np.testing.assert_allclose(same["kinetic"], 0.5 * 14 * 14 / 3, rtol=1e-6)
    # what moves does not turn transparent for it
    assert (np.asarray(back["by weight"]) == 0).all()


def test_magnitude_sums_samples_not_axes():
    """Opposite flow of two halves of a ray cancels; of two axes it does not."""
    along = np.float32([[[1, 0, 0], [1, 0, 0], [-1, 0, 0], [-1, 0, 0]]])
    across = np.float32([[[1, -1, 0]] * 4])
    weight = np.full((1, 4), 0.25, np.float32)
    assert of_flow(along, along, weight)["magnitude"] == 0
    magnitude = of_flow(across, across, weight)["magnitude"]
    np.testing.assert_allclose(magnitude, 2 / 3, rtol=1e-6)


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
    np.testing.assert_allclose(expected_value(weight, values), 0.9 + 0.5 + 1.0)
    nothing = expected_value(np.zeros((1, 3)), values)
    np.testing.assert_array_equal(nothing, [[5.0]])


def test_depth_is_compared_up_to_scale_and_offset(dtype):
    depth = np.random.default_rng(1).uniform(1, 4, 21).astype(dtype)
    known = np.arange(21) != 7
    odd = np.where(known, 3 * depth + 2, 1e30).astype(dtype)
    assert normalized_depth(depth, odd, known)[0] < 1e-11
    other, _ = normalized_depth(depth, -depth, known)
    offset = depth[known].astype(np.float64)
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
    value_and_grad = normalized_depth(
        np.asarray(depth, dtype), target, np.arange(4) < count
    )
    value, grad = map(np.asarray, value_and_grad)
    assert np.isfinite(value)
    assert value < 10
    assert np.abs(grad).max() <= 5 / flow_losses.FLATTEST / max(max(depth), 1e-3)
    if count < 2:
        assert value == 0
        assert (grad == 0).all()


def test_slopes_are_those_of_differences(float64, rng):
    """Of all terms together, each of which is about one."""
    rays, samples = 5, 4
    flow, back = (rng.normal(size=(rays, samples, 3)) for _ in "ab")
    seen = rng.uniform(0.1, 1, (rays, samples))
    weight = jnp.asarray(rng.uniform(0, 0.2, (rays, samples)))
    color, target = (rng.uniform(size=(rays, 3)) for _ in "ab")
    depth, other = rng.uniform(1, 5, rays), jnp.asarray(rng.uniform(1, 25, rays))
    present = np.array([True, True, False, True, True])
    mask = jnp.asarray(np.where(present, rng.uniform(size=rays), 0))
    target, present = jnp.asarray(target), jnp.asarray(present)

    def total(flow, back, seen, color, depth, through):
        return (
            10 * flow_losses.warp_error(color, target, weight, seen, mask)
            + flow_losses.cycle(flow, back, seen, present)
            + 10 * flow_losses.magnitude(flow, weight, present)
            + flow_losses.smoothness(flow, present)
            + flow_losses.kinetic(flow, back, present)
            + 10 * flow_losses.entropy(4 * seen - 2)
            + jnp.sum(flow_losses.expected_value(through, flow) ** 2)
            + flow_losses.normalized_depth(depth, other, present)
        )

    inputs = flow, back, seen, color, depth, rng.uniform(0, 0.2, (rays, samples))
    assert gradients.directional_error(total, *inputs, step=1e-6) < 1e-7
