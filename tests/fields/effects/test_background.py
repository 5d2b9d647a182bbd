"""Static points stay put: against loops, counted draws and central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields.effects import background
from nerfies_jax.fields.effects.background import BackgroundSpec
from nerfies_jax.fields.effects.effect import Box
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from nerfies_jax.training.model import Frames
from tests import gradients

CENTER, SCALE = np.array([1.0, -2.0, 3.0]), 0.25


def context(displace, points, frames, dtype, key=None):
    """Frame k is at time k / 10."""
    fields = dict.fromkeys(PenaltyContext._fields)
    times = jnp.asarray(np.arange(frames) / 10, dtype)
    seen = Frames(**dict.fromkeys(Frames._fields))
    return PenaltyContext(
        **fields
        | {
            "displace": displace,
            "condition_of": lambda row: FrameCondition(times[row], {}, jnp.int32(0)),
            "frames": seen._replace(points=jnp.asarray(points, dtype), times=times),
            "box": Box(jnp.asarray(CENTER, dtype), jnp.asarray(SCALE, dtype)),
            "key": jax.random.key(0) if key is None else key,
        }
    )


def overheard(heard, x, time):
    """x; the whole batch of both is appended to `heard`, in float64.

    For float32 alone: the listener's thread knows nothing of x64.
    """

    def listen(x, time):
        heard.append((np.array(x, np.float64), np.array(time, np.float64)))
        return np.asarray(x)

    return jax.pure_callback(listen, x, x, time, vmap_method="broadcast_all")


def geman_mcclure(squared, width, scaling):
    scale = {"paper": 1.0, "official": width}[scaling]
    return scale * 2 * (squared / width**2) / (squared / width**2 + 4)


@pytest.mark.parametrize(
    "scaling", ["paper", pytest.param("official", marks=pytest.mark.full)]
)
def test_points_are_seen_in_the_field_in_all_frames(scaling, rng):
    """Each point once where there are few; frames alike often; noise of its size."""
    points = rng.normal(size=(6000, 3)) + CENTER
    spec = BackgroundSpec(points=6000, noise=0.5, width=0.2, scaling=scaling)
    heard = []

    def displace(x, condition):
        x = overheard(heard, x, condition.time)
        return 0.1 * x + condition.time

    assert spec.required_data == {"points"}

    @jax.jit
    def penalty(key):
        return spec.loss(None, context(displace, points, 7, "float32", key))

    value = float(penalty(jax.random.key(0))["background"].value)
    ((x, times),) = heard
    assert x.shape == (6000, 3)
    costs = geman_mcclure(
        np.sum((0.1 * x + times[:, None]) ** 2, axis=-1), 0.2, scaling
    )
    np.testing.assert_allclose(value, costs.mean(), rtol=2e-6)
    frames, counts = np.unique(np.round(times * 10), return_counts=True)
    np.testing.assert_array_equal(frames, np.arange(7))
    assert np.all(np.abs(counts - 6000 / 7) < 5 * np.sqrt(6000 / 7))
    noise = x - (points - CENTER) * SCALE
    assert abs(noise.std() - 0.5) < 0.02
    assert abs(noise.mean()) < 0.02
    # frames and noise come of different keys: neither tells of the other
    assert abs(np.corrcoef(times, noise[:, 0])[0, 1]) < 0.06


@pytest.mark.full
def test_of_many_points_as_many_as_asked_are_drawn():
    points = np.arange(3000.0).reshape(1000, 3)
    spec = BackgroundSpec(points=400, noise=0.0)
    heard, seen = [], []

    @jax.jit
    def drift(key):
        def displace(x, condition):
            return 0 * overheard(heard, x, condition.time)

        return background.drift(spec, context(displace, points, 3, "float32", key))

    for key in range(2):
        assert drift(jax.random.key(key)) == 0
        rows = heard[-1][0] / SCALE + CENTER
        np.testing.assert_allclose(rows[:, 1] - rows[:, 0], 1, atol=2e-3)
        seen.append(np.round(rows[:, 0] / 3).astype(int))
        assert len(seen[-1]) == 400
        assert len(np.unique(seen[-1])) > 290  # 1000 (1 - e^-0.4) = 330 are expected
        assert seen[-1].min() < 50
        assert seen[-1].max() > 950
    assert not np.array_equal(*seen)


@pytest.mark.hard_cases
def test_a_still_warp_costs_nothing_and_has_a_finite_slope(dtype, rng):
    """Zero, and displacements whose square underflows."""
    points = rng.normal(size=(20, 3))

    @jax.jit
    @jax.value_and_grad
    def drift(shift):
        here = context(lambda x, _: shift + 0 * x, points, 2, dtype)
        return background.drift(BackgroundSpec(), here)

    for size in (0.0, 1e-25, 1e-15):
        value, grad = drift(np.asarray([size] * 3, dtype))
        assert 0 <= value < 1e-25
        assert np.all(np.isfinite(grad))
        # ρ is 1e-3 s / (2e-6) there
        np.testing.assert_allclose(grad, 1e3 * size, rtol=1e-5)


@pytest.mark.hard_cases
def test_without_a_robust_loss_it_is_the_mean_distance(dtype, rng):
    """Points that stay put are among them, and have no gradient."""
    points = rng.normal(size=(20, 3)) + CENTER

    @jax.jit
    @jax.value_and_grad
    def drift(shift):
        def displace(x, condition):
            return jnp.where(x[0] > 0, shift * x, 0)

        here = context(displace, points, 1, dtype)
        return background.drift(BackgroundSpec(width=None, noise=0.0), here)

    shift = np.asarray([0.3, -0.1, 0.2], dtype)
    value, grad = drift(shift)
    at = (points - CENTER) * SCALE
    moving = [shift * x for x in at if x[0] > 0]
    assert 0 < len(moving) < 20
    lengths = [np.sqrt(x @ x) for x in moving]
    np.testing.assert_allclose(value, sum(lengths) / 20, rtol=1e-5)
    # of |s x|: s x^2 / |s x|
    slopes = [
        shift * x**2 / length
        for x, length in zip([x for x in at if x[0] > 0], lengths, strict=True)
    ]
    np.testing.assert_allclose(grad, np.sum(slopes, axis=0) / 20, rtol=1e-5)
    value, grad = drift(np.zeros(3, dtype))
    np.testing.assert_array_equal([value, *grad], 0)


@pytest.mark.parametrize("width", [0.1, None])
def test_gradients(width, float64, rng):
    points = rng.normal(size=(30, 3)) + CENTER

    def total(params):
        def displace(x, condition):
            return jnp.sin(params @ x + condition.time)

        here = context(displace, points, 4, "float64")
        return background.drift(BackgroundSpec(width=width, scaling="paper"), here)

    params = 0.1 * rng.normal(size=(3, 3))
    assert gradients.directional_error(total, params, step=1e-6) < 1e-6
