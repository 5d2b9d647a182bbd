"""Latent tables: what they hold, and what becomes of an id outside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.nn import codes
from tests import gradients


def test_codes_are_centered_and_bounded(dtype):
    init = jax.jit(lambda key: codes.init(key, 500, 8, dtype=jnp.dtype(dtype)))
    table = np.asarray(init(jax.random.key(0)))
    assert table.shape == (500, 8)
    assert table.dtype == dtype
    assert 0.049 < np.max(table) <= 0.05
    assert -0.05 <= np.min(table) < -0.049
    assert abs(np.mean(table)) < 4 * 0.05 / np.sqrt(3 * table.size)


blend = jax.jit(codes.blend)
at_time = jax.jit(jax.vmap(codes.at_time, (None, 0)))


def test_blending_walks_from_one_code_to_the_other(dtype, rng):
    table = rng.normal(size=(4, 3)).astype(dtype)
    for progress in (0.0, 0.25, 1.0):
        blended = blend(table, 1, 3, np.asarray(progress, dtype))
        truth = table[1] * (1 - progress) + table[3] * progress
        np.testing.assert_allclose(blended, truth, rtol=1e-6)
    assert np.array_equal(blended, table[3])  # arrives exactly


def test_a_table_is_read_as_if_of_fewer_rows(dtype, rng):
    """As NumPy resamples it to so many rows, and then interpolates between those."""
    table = rng.normal(size=(7, 2)).astype(dtype)
    times = np.linspace(-0.1, 1.1, 25).astype(dtype)
    read = jax.jit(jax.vmap(codes.at_time_of, (None, None, 0)))
    for rows in (2, 3, 5, 7, 40):
        count = min(rows, 7)
        own, few = np.linspace(0, 1, 7), np.linspace(0, 1, count)
        truth = [
            np.interp(times, few, np.interp(few, own, column)) for column in table.T
        ]
        answers = read(table, np.asarray(rows, dtype), times)
        np.testing.assert_allclose(answers, np.transpose(truth), atol=3e-6)
    alone = read(table[:1], np.asarray(5, dtype), times)
    np.testing.assert_allclose(alone, np.tile(table[:1], (25, 1)), rtol=1e-6)


def test_time_interpolates_like_numpy(dtype, rng):
    table = rng.normal(size=(5, 2)).astype(dtype)
    times = np.asarray([-0.5, 0.0, 0.1, 0.25, 0.6, 1.0, 1.5], dtype)
    truth = [np.interp(times, np.linspace(0, 1, 5), column) for column in table.T]
    np.testing.assert_allclose(at_time(table, times), np.transpose(truth), atol=1e-6)
    alone = at_time(table[:1], times)
    assert np.array_equal(alone, np.resize(table[0], (7, 2)))


@pytest.mark.hard_cases
def test_an_id_outside_is_never_nan():
    """`jnp.take` answers NaN, and -1 would be the last row."""
    table, look_up = np.arange(6.0).reshape(3, 2), jax.jit(codes.look_up)
    for index, row in ((-1, 0), (-(10**6), 0), (3, 2), (10**6, 2), (1, 1)):
        assert np.array_equal(look_up(table, index), table[row])


def test_gradients_reach_the_two_rows_only(float64, rng):
    table, progress = rng.normal(size=(4, 3)), np.float64(0.3)

    def total(table, progress):
        return jnp.sum(codes.blend(table, jnp.int32(0), jnp.int32(2), progress) ** 3)

    assert gradients.directional_error(total, table, progress) < 1e-7
    grad = np.asarray(jax.jit(jax.grad(total))(table, progress))
    assert np.array_equal(np.any(grad != 0, axis=1), [True, False, True, False])


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        ([0, 3, 4, 9], r"warp_ids\[2\] = 4 is not in 0 .. 3; use a table of 10 rows"),
        ([0, -1], r"warp_ids\[1\] = -1"),
        ([0.0, 1.0], "whole numbers"),
    ],
)
def test_bad_ids_are_refused_on_the_host(ids, message):
    codes.check_ids(np.asarray([0, 3, 1], np.int32), 4)
    with pytest.raises(ValueError, match=message):
        codes.check_ids(ids, 4, "warp_ids")
