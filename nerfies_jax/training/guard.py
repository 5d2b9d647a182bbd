"""What a run falls back to when a step is not finite, and what was wrong in it."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.training.model import TrainState

RENEW_SECONDS = 0.5  # between copies
RENEW_SHARE = 0.05  # of the time may go into copies


class Snapshot:
    """The last good state in host memory, so that the device holds it only once."""

    def __init__(self, step: int, state: TrainState):
        began = time.monotonic()
        leaves, self._structure = jax.tree.flatten(state)
        self._leaves = [_to_host(leaf) for leaf in leaves]
        self.step = step
        self.taken = time.monotonic()
        self._cost = self.taken - began

    def state(self) -> TrainState:
        """A fresh copy on the device."""
        return jax.tree.unflatten(
            self._structure, [_to_device(*leaf) for leaf in self._leaves]
        )

    def renewed(self, step: int, state: TrainState, after_event: bool) -> "Snapshot":
        """A new one if that is cheap by now, and always after an event.

        A replay from here is steps alone, so no event may lie in between.
        """
        if not after_event:
            wait = max(RENEW_SECONDS, self._cost / RENEW_SHARE)
            if time.monotonic() - self.taken < wait:
                return self
        return Snapshot(step, state)


def _to_host(leaf):
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        impl = jax.random.key_impl(leaf)
        return np.array(jax.random.key_data(leaf), copy=True), None, impl
    sharding = leaf.sharding if isinstance(leaf, jax.Array) else None
    return np.array(leaf, copy=True), sharding, None


def _to_device(array, sharding, key_impl):
    # Never an alias of the host copy: a donated buffer is written to.
    placed = jax.device_put(array, sharding, may_alias=False)
    return (
        placed if key_impl is None else jax.random.wrap_key_data(placed, impl=key_impl)
    )


def last_good(program, snapshot, frames, bad_step):
    """The state before the first bad step, that step's number, and what was bad in it.

    Metrics are looked at after every step and parameters after every chunk, so the
    first bad step is found by bisection from the last copy; steps are deterministic.
    """

    def replay(count):
        if count == 0:
            return snapshot.state(), True, {}
        state, outcome = program(snapshot.state(), frames, np.int32(count))
        outcome = jax.device_get(outcome)
        return state, outcome.metrics_finite and outcome.params_finite, outcome.metrics

    good, bad = 0, bad_step - snapshot.step
    if replay(bad)[1]:
        detail = (
            f"step {bad_step:,} or one before was not finite, but not so when repeated"
        )
        return snapshot.state(), snapshot.step, detail
    while bad - good > 1:
        middle = (good + bad) // 2
        if replay(middle)[1]:
            good = middle
        else:
            bad = middle
    state, _, metrics = replay(bad)
    names = [f"metric {name}" for name, x in metrics.items() if not np.isfinite(x)]
    names += bad_arrays(state.params, "params") + bad_arrays(
        state.optimiser, "optimiser"
    )
    shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if names[4:] else "")
    detail = f"step {snapshot.step + bad:,} is not finite: {shown}"
    return replay(good)[0], snapshot.step + good, detail


def bad_arrays(tree, root):
    """Paths of the arrays that are not finite, and how much of them."""
    found = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            continue
        bad = ~np.isfinite(np.asarray(leaf, np.float64))
        if bad.any():
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            found.append(f"{root}.{name} ({bad.sum():,} of {bad.size:,} values)")
    return found
