"""Latent tables: what they hold, and what becomes of an id outside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.nets import codes
from tests import gradients


def test_codes_are_centred_and_bounded(dtype):
    table = codes.init(jax.random.key(0), 500, 8, dtype=jnp.dtype(dtype))
    assert table.shape == (500, 8)
    assert table.dtype == dtype
    assert 0.049 < np.max(table) <= 0.05
    assert -0.05 <= np.min(table) < -0.049
    assert abs(np.mean(table)) < 4 * 0.05 / np.sqrt(3 * table.size)


def test_blending_walks_from_one_code_to_the_other(dtype, rng):
    table = jnp.asarray(rng.normal(size=(4, 3)), dtype)
    blend = jax.jit(codes.blend)
    for progress in (0.0, 0.25, 1.0):
        found = blend(
            table, jnp.asarray(1), jnp.asarray(3), jnp.asarray(progress, dtype)
        )
        truth = np.asarray(table[1]) * (1 - progress) + np.asarray(table[3]) * progress
        np.testing.assert_allclose(found, truth, rtol=1e-6)
    assert np.array_equal(found, table[3])  # arrives exactly


def test_time_interpolates_like_numpy(dtype, rng):
    table = jnp.asarray(rng.normal(size=(5, 2)), dtype)
    at_time = jax.jit(codes.at_time)
    for time in (-0.5, 0.0, 0.1, 0.25, 0.6, 1.0, 1.5):
        found = at_time(table, jnp.asarray(time, dtype))
        truth = [np.interp(time, np.linspace(0, 1, 5), column) for column in table.T]
        np.testing.assert_allclose(found, truth, atol=1e-6)
    assert np.array_equal(at_time(table[:1], jnp.asarray(0.7, dtype)), table[0])


@pytest.mark.hard_cases
@pytest.mark.parametrize(("index", "row"), [(-1, 0), (-(10**6), 0), (3, 2), (10**6, 2)])
def test_an_id_outside_is_never_nan(index, row):
    """`jnp.take` answers NaN, and -1 would be the last row."""
    table = jnp.arange(6.0).reshape(3, 2)
    assert np.array_equal(jax.jit(codes.look_up)(table, jnp.asarray(index)), table[row])
    assert np.all(np.isnan(jnp.take(table, jnp.asarray(3), axis=0)))


def test_gradients_reach_the_two_rows_only(float64, rng):
    table = jnp.asarray(rng.normal(size=(4, 3)))

    def total(table, progress):
        return jnp.sum(
            codes.blend(table, jnp.asarray(0), jnp.asarray(2), progress) ** 3
        )

    progress = jnp.asarray(0.3)
    assert gradients.directional_error(total, table, progress) < 1e-7
    grad = jax.grad(total)(table, progress)
    assert np.all(grad[jnp.asarray([1, 3])] == 0)
    assert np.all(grad[jnp.asarray([0, 2])] != 0)


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        ([0, 3, 4, 9], r"warp_ids\[2\] = 4 is not in 0 .. 3; give the table 10 rows"),
        ([0, -1], r"warp_ids\[1\] = -1"),
        ([0.0, 1.0], "whole numbers"),
    ],
)
def test_bad_ids_are_refused_on_the_host(ids, message):
    with pytest.raises(ValueError, match=message):
        codes.check_ids(ids, 4, "warp_ids")


def test_good_ids_pass():
    codes.check_ids(np.asarray([0, 3, 1], np.int32), 4)


@pytest.mark.parametrize(("ids", "width"), [(0, 8), (3, 0)])
def test_empty_tables_are_refused(ids, width):
    with pytest.raises(ValueError, match=f"ids={ids}, width={width}"):
        codes.init(jax.random.key(0), ids, width)
