"""Schedules against the papers' formulas in Python floats, at and past their ends."""

import math

import jax
import numpy as np

from nerfies_jax.training import schedules

RTOL = {"float32": 1e-6, "float64": 1e-14}


def evaluate(schedule, steps, dtype):
    values = jax.jit(schedule)(np.int32(steps))
    assert values.dtype == dtype
    return np.asarray(values)


def test_log_linear_is_the_3dgs_rate(dtype):
    schedule = schedules.log_linear(1.6e-4, 1.6e-6, 30_000)
    steps = [0, 1, 2999, 15_000, 29_999, 30_000, 50_000]
    expected = [
        math.exp((1 - t) * math.log(1.6e-4) + t * math.log(1.6e-6))
        for t in (min(step / 30_000, 1) for step in steps)
    ]
    np.testing.assert_allclose(evaluate(schedule, steps, dtype), expected, RTOL[dtype])


def test_log_linear_warms_up_as_mip_nerf_does(dtype):
    schedule = schedules.log_linear(5e-4, 5e-6, 1000, delay_steps=100, delay=0.01)
    steps = [0, 1, 50, 99, 100, 101, 1000]
    expected = []
    for step in steps:
        factor = 0.01 + 0.99 * math.sin(math.pi / 2 * min(step / 100, 1))
        expected.append(factor * 5e-4 * 0.01 ** (step / 1000))
    np.testing.assert_allclose(evaluate(schedule, steps, dtype), expected, RTOL[dtype])


def test_ramp_is_exact_at_its_ends_and_straight_between(dtype):
    schedule = schedules.ramp(0.3, 8.1, 7, after=3)
    values = evaluate(schedule, [0, 3, 10, 11, 10**6], dtype)
    assert list(values) == [np.asarray(x, dtype) for x in (0.3, 0.3, 8.1, 8.1, 8.1)]
    between = evaluate(schedule, [4, 6], dtype)
    np.testing.assert_allclose(between, [0.3 + 7.8 / 7, 0.3 + 7.8 * 3 / 7], RTOL[dtype])


def test_a_ramp_late_in_a_long_run_keeps_its_steps():
    schedule = schedules.ramp(0.0, 4.0, 4, after=2**24)
    # float32 has no 2^24 + 1: the middle values need integer arithmetic.
    values = evaluate(schedule, [2**24 + k for k in range(5)], "float32")
    assert list(values) == [0, 1, 2, 3, 4]


def test_cosine_is_the_elastic_weight_of_nerfies(dtype):
    schedule = schedules.cosine(1e-2, 1e-8, 100_000, after=50_000)
    steps = [0, 50_000, 50_100, 100_000, 149_900, 150_000, 10**6]
    expected = []
    for step in steps:
        t = min(max(step - 50_000, 0) / 100_000, 1)
        risen = math.sin(math.pi / 2 * t) ** 2
        left = math.cos(math.pi / 2 * t) ** 2
        expected.append(1e-2 * left + 1e-8 * risen)
    values = evaluate(schedule, steps, dtype)
    # float32: cos^2 near pi/2 squares a share that is a difference from one.
    rtol = {"float32": 2e-4, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(values, expected, rtol)
    assert values[-1] == np.asarray(1e-8, dtype)
    assert np.all(np.diff(values) <= 0)


def test_time_noise_is_a_tenth_of_a_frame_and_ends(dtype):
    schedule = schedules.time_noise(frames=50, steps=1000)
    values = evaluate(schedule, [0, 500, 1000, 2000], dtype)
    np.testing.assert_allclose(values, [0.002, 0.001, 0, 0], RTOL[dtype])
