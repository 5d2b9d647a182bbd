"""The penalty on unrest: its value, its ends in time, its rows and its slopes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core import splats as rows
from gaussians_jax.core.splats import Params
from gaussians_jax.losses import acceleration
from gaussians_jax.losses.acceleration import AccelerationSpec
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from tests import gradients
from tests.gaussians.shared import any_nonzero, finite, full, jitted, put

unrest = jitted(acceleration.acceleration_loss, static_argnums=(4, 5))
sample_times = jitted(jax.vmap(acceleration.sample_times, (0, None)), static_argnums=1)
draw_active = jitted(acceleration.draw_active, static_argnums=2)


def scene(count=12, active=None, dtype="float32", size=1.0):
    """Gaussians and, under "amplitude", how far each swings."""
    rng = np.random.default_rng(0)
    mean = size * rng.normal(size=(count, 3))
    active = np.ones(count, bool) if active is None else active
    splats = rows.Splats(
        mean,
        *(np.zeros((count, n)) for n in (3, 4)),
        np.where(active, 0, rows.INACTIVE_LOGIT),
        *(np.zeros((count, n, 3)) for n in (1, 0)),
    )
    amplitude = 0.02 * size * rng.normal(size=(count, 3))
    return put(Params({"splats": splats, "amplitude": amplitude}, {}), dtype)


def swinging(params, time):
    """A motion with a closed form: amplitude sin(5 t) + amplitude^2 t^2."""
    gaussians = rows.activate(params.rows["splats"])
    swing = params.rows["amplitude"]
    moved = swing * jnp.sin(5 * time) + jnp.square(swing) * jnp.square(time)
    return gaussians._replace(mean=gaussians.mean + moved)


def places(params, time):
    mean = np.asarray(params.rows["splats"].mean, np.float64)
    swing = np.asarray(params.rows["amplitude"], np.float64)
    return mean + swing * np.sin(5 * time) + swing**2 * time**2


def slow_unrest(canonical, before, now, after, decay, drift):
    total = 0.0
    for c, b, n, a in zip(canonical, before, now, after, strict=True):
        second = np.linalg.norm(a - 2 * n + b) ** 2
        first = np.linalg.norm((a - b) / 2) ** 2
        total += np.exp(-np.linalg.norm(n - c) / decay) * (second + drift * first)
    return total / len(canonical) / decay**2


@pytest.mark.parametrize("drift", [0.5, *full(0.0)])
def test_unrest_is_the_weighed_sum_of_differences(drift, dtype):
    rng = np.random.default_rng(0)
    four = rng.normal(size=(4, 9, 3)).astype(dtype)
    value = unrest(*four, 2.0, drift)
    expected = slow_unrest(*four.astype(np.float64), 2.0, drift)
    tolerance = {"float32": 1e-6, "float64": 1e-13}[dtype]
    np.testing.assert_allclose(value, expected, rtol=tolerance)
    assert value.dtype.name == dtype


def test_gradients_with_the_weight_held(float64):
    rng = np.random.default_rng(0)
    canonical, *three = put(tuple(rng.normal(size=(4, 9, 3))))
    weight = np.exp(-np.linalg.norm(three[1] - np.asarray(canonical), axis=1) / 2)

    def held(before, now, after):  # the weight as a constant
        second = jnp.sum((after - 2 * now + before) ** 2, axis=1)
        first = jnp.sum(((after - before) / 2) ** 2, axis=1)
        return jnp.mean(weight * (second + 0.5 * first)) / 4

    def ours(before, now, after):
        return acceleration.acceleration_loss(canonical, before, now, after, 2.0, 0.5)

    assert gradients.directional_error(held, *three) < 1e-8
    grads, expected = (jitted(jax.grad(f, (0, 1, 2)))(*three) for f in (ours, held))
    np.testing.assert_allclose(grads, expected, atol=1e-14)


@pytest.mark.hard_cases
def test_a_steady_drift_is_seen_by_the_first_difference_alone(dtype):
    step = np.asarray([0.25, 0, 0])
    motion = [np.tile(n * step, (5, 1)).astype(dtype) for n in range(4)]
    assert unrest(*motion, 1.0, 0.0) == 0
    expected = np.exp(-0.5) * 0.0625
    np.testing.assert_allclose(unrest(*motion, 1.0, 1.0), expected, rtol=1e-6)


@jax.jit
@functools.partial(jax.value_and_grad, argnums=(0, 1, 2))
def energy(before, now, after):
    """From a Gaussian that belongs to the origin."""
    canonical = jnp.zeros_like(now)
    return acceleration.acceleration_loss(canonical, before, now, after, 1.0, 1.0)


@pytest.mark.hard_cases
@pytest.mark.parametrize("distance", [0.0, 1e-30, 1e-10, 1.0, 100.0, 1e15])
def test_slopes_are_finite_at_any_distance_and_free_far_away(distance, dtype):
    now = np.asarray([[distance, 0, 0]], dtype)
    value, grads = energy(now - now.dtype.type(0.5), now, now)
    assert finite((value, grads))
    if distance < 1e-6:
        np.testing.assert_allclose(value, 0.75 + 0.75 / 4, rtol=1e-6)
    if distance >= 100:
        assert float(value) < 1e-30  # exp(-100) is 4e-44
    assert not any_nonzero(energy(now, now, now))


@pytest.mark.hard_cases
@pytest.mark.parametrize("interval", [1 / 300, 0.5, 0.8, *full(1 / 7)])
def test_the_three_times_stay_within_the_capture(interval, dtype):
    times = np.asarray([0.0, 1e-3, 0.3, 0.5, 1 - 1e-3, 1.0], dtype)
    before, now, after = np.asarray(sample_times(times, interval), np.float64).T
    assert ((before >= 0) & (after <= 1)).all()
    step = min(interval, 0.5)
    np.testing.assert_allclose([now - before, after - now], step, rtol=2e-5)
    inner = (step < times) & (times < 1 - step)
    np.testing.assert_allclose(now[inner], times[inner], rtol=1e-6)


@pytest.mark.parametrize("places", [[1, 2, 5, 8, 9], *full([3], [0, 11])])
def test_rows_are_drawn_evenly_from_the_active(places):
    active = np.isin(np.arange(12), places)
    sample = draw_active(jax.random.key(0), active, 6000)
    counts = np.bincount(sample, minlength=12)
    assert set(np.flatnonzero(counts)) == set(places)
    share = 6000 / len(places)
    assert np.abs(counts[places] - share).max() < 5 * np.sqrt(share)


@functools.cache
def compiled_penalty(spec, at_time, extent):
    regularizer = acceleration.Bound(spec, extent, 11)

    def penalty(params, time, step, seed):
        condition = FrameCondition(time, step=step, key=jax.random.key(seed))
        context = PenaltyContext(condition, step, None, params, at_time=at_time)
        return regularizer.loss(params, context)

    return jitted(penalty)


def ask(spec, params, time, step=0, at_time=swinging, extent=1.0, seed=0):
    time = np.asarray(time, params.rows["splats"].mean.dtype)
    return compiled_penalty(spec, at_time, extent)(params, time, step, seed)


@pytest.mark.parametrize("time", [0.43, *full(0.0, 1.0)])
def test_the_effect_is_the_mean_over_the_rows_it_draws(time, dtype):
    spec = AccelerationSpec(weight=0.3, decay=0.02, drift=0.5, interval=2.0, start=9)
    active = np.arange(12) % 4 != 1
    params = scene(active=active, dtype=dtype)
    before, terms = (ask(spec, params, time, step, extent=3.0) for step in (8, 9))
    assert before["unrest"].value == 0
    key = jax.random.fold_in(jax.random.key(0), acceleration._STREAM)
    sample = draw_active(key, active, 12)
    middle = np.clip(time, 0.2, 0.8)
    expected = slow_unrest(
        np.asarray(params.rows["splats"].mean, np.float64)[sample],
        *(places(params, t)[sample] for t in (middle - 0.2, middle, middle + 0.2)),
        0.06,
        0.5,
    )
    # In float32 a place near 1 has an ulp of 1e-7, differences are near 0.01.
    tolerance = {"float32": 3e-4, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(terms["unrest"].value, expected, rtol=tolerance)
    assert terms["unrest"].weight == 0.3
    assert 0 < terms["still"].value < 1
    assert terms["still"].weight is None


@pytest.mark.hard_cases
def test_without_active_rows_there_is_nothing(dtype):
    terms = ask(AccelerationSpec(), scene(active=np.zeros(12, bool), dtype=dtype), 0.4)
    assert {name: term.value for name, term in terms.items()} == {
        "unrest": 0,
        "still": 0,
    }
