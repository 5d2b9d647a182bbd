"""Equal shares of a step: the same state from one device and from several."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.runtime import data_parallel
from tests import fresh_process
from tests.training import toy


def shared_step(devices):
    """Return the step of the toy from the mean of eight noisy gradients."""

    def part(index, state, frames):
        key = jax.random.fold_in(state.key, index)
        noise = 0.1 * jax.random.normal(key, state.params.rows["mean"].shape)
        target = frames.times[index % 4]
        return jax.value_and_grad(toy.loss)(state.params, target, noise)

    def step(state, frames):
        each = data_parallel.on_devices(part, 8, devices, state, frames)
        value, grad = jax.tree.map(lambda leaf: leaf.mean(0), each)
        params = jax.tree.map(lambda p, g: p - 0.1 * g, state.params, grad)
        state = state._replace(params=params, step=state.step + 1)
        return state, {"loss": value}

    return step


def trained(devices):
    model = toy.model(change=shared_step(devices))._replace(devices=devices)
    return toy.fit(toy.frames(), model=model, steps=8)  # an event after seven


def weighed(factor, row, more):
    return factor * jnp.sum(row) + more


def sums_of_rows():
    """Of three rows: two devices are left with one."""
    rows = np.arange(6.0).reshape(3, 2), np.array([10.0, 20.0, 30.0])
    sums = data_parallel.rows_on_devices(weighed, 2.0, rows)
    return [float(each) for each in sums]


def test_each_row_is_worked_on_once_and_in_order():
    assert sums_of_rows() == [12.0, 30.0, 48.0]


def both(devices):
    assert jax.local_device_count() == devices
    assert sums_of_rows() == [12.0, 30.0, 48.0]
    images = data_parallel.shared(jnp.ones((64, 64)), devices).addressable_shards
    assert len({each.data.unsafe_buffer_pointer() for each in images}) == 1
    one, several = trained(1), trained(devices)
    for ours, plain in zip(
        *map(jax.tree.leaves, (several.state, one.state)), strict=True
    ):
        assert ours.sharding.num_devices == 1
        assert jax.typeof(ours) == jax.typeof(plain)  # else events compile once more
        if not jnp.issubdtype(plain.dtype, jax.dtypes.prng_key):
            np.testing.assert_allclose(ours, plain, rtol=1e-5, atol=1e-7)
    # Chunks are cut by the clock: the last row alone is of the same steps.
    last = [run.history.rows[-1]["loss"] for run in (several, one)]
    np.testing.assert_allclose(*last, rtol=1e-5)


@pytest.mark.parametrize(("shares", "most", "used"), [(4, 3, 2), (4, 9, 4), (5, 3, 1)])
def test_devices_take_equal_shares(shares, most, used, monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: most)
    assert data_parallel.device_count(shares) == used


def test_a_divisible_share_takes_the_devices_that_are_asked_for(monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: 4)
    assert data_parallel.device_count(1, divisible=True) == 1  # not by itself
    monkeypatch.setattr(data_parallel, "_limit", 3)
    assert data_parallel.device_count(1, divisible=True) == 3
    assert data_parallel.device_count(2, divisible=True) == 2
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    data_parallel.check_hosts(1, "batch_size", divisible=True)
    with pytest.raises(ValueError, match="set batch_size to a multiple of 2"):
        data_parallel.check_hosts(1, "batch_size")


def test_a_share_counts_on_from_the_steps_where_x64_is_on():
    """As a batch does: of the steps, an int32, its size and the share."""
    with jax.enable_x64(True):
        visits = data_parallel.on_devices(
            lambda share, step: step * 2 + share, 2, 1, jnp.int32(3)
        )
    assert visits.dtype == jnp.int32
    assert visits.tolist() == [6, 7]


@pytest.mark.slow
def test_eight_devices_train_what_one_does():
    """The devices of the flag of XLA, which precedes the choice of `start_jax`."""
    fresh_process.run(
        "import os; os.environ.pop('JAX_NUM_CPU_DEVICES', None);"
        "os.environ['XLA_FLAGS'] = '--xla_force_host_platform_device_count=8';"
        "from nerfies_jax.runs import platform; platform.start_jax('cpu', 'one', 2);"
        "from tests.training import test_data_parallel as t; t.both(8)"
    )
