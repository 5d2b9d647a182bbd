"""Recovery from a non-finite training step: the last finite state, and a diagnosis."""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.training.chunk import Outcome
from nerfies_jax.training.frame_stream import TrainingFrames
from nerfies_jax.training.model import TrainState

RENEW_SECONDS = 0.5  # minimum time between copies
RENEW_SHARE = 0.05  # maximum fraction of the time for copies


class Snapshot:
    """Copy of the last finite state in host memory, to save device memory."""

    def __init__(self, step: int, state: TrainState):
        began = time.monotonic()
        leaves, self._structure = jax.tree.flatten(state)
        self._leaves = [_to_host(leaf) for leaf in leaves]
        self.step = step
        self._copied_at = time.monotonic()
        self._cost = self._copied_at - began

    def state(self) -> TrainState:
        """Return a copy of the state on the device.

        Returns:
          The training state.
        """
        return jax.tree.unflatten(
            self._structure, [_to_device(*leaf) for leaf in self._leaves]
        )

    def renew(self, step: int, state: TrainState, after_event: bool) -> "Snapshot":
        """Return a newer snapshot if its cost is acceptable, and always after an event.

        A replay from a snapshot runs steps only, so it must not cross an event.

        Args:
          step: Number of completed steps.
          state: Training state after these steps.
          after_event: True if an event has changed the state since the snapshot.

        Returns:
          A new snapshot, or this one.
        """
        if not after_event:
            wait = max(RENEW_SECONDS, self._cost / RENEW_SHARE)
            if time.monotonic() - self._copied_at < wait:
                return self
        return Snapshot(step, state)


def _to_host(leaf):
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        impl = jax.random.key_impl(leaf)
        return np.array(jax.random.key_data(leaf), copy=True), None, impl
    sharding = leaf.sharding if isinstance(leaf, jax.Array) else None
    return np.array(leaf, copy=True), sharding, None


def _to_device(array, sharding, key_impl):
    # Must not alias the host copy, because donated buffers are overwritten.
    on_device = jax.device_put(array, sharding, may_alias=False)
    return (
        on_device
        if key_impl is None
        else jax.random.wrap_key_data(on_device, impl=key_impl)
    )


def last_good(
    program: Callable[[TrainState, TrainingFrames, int], tuple[TrainState, Outcome]],
    snapshot: Snapshot,
    frames: TrainingFrames,
    good_step: int,
    bad_step: int,
) -> tuple[TrainState, int, str]:
    """Find the state before the first non-finite step.

    Metrics are checked after every step, but the state only after every scan of steps.
    The first bad step is found by bisection. Steps are deterministic and are repeated
    from the last snapshot.

    Args:
      program: A `chunk.Program`, `program(state, frames, count)`.
      snapshot: Last copy of a good state.
      frames: Training frames.
      good_step: Step at the end of the last good chunk, counted from the start of the
        run.
      bad_step: Step after which a value was not finite.

    Returns:
      The last good state, its step, and a description of the values that were not
      finite.
    """

    def replay(step):
        if step == snapshot.step:
            return snapshot.state(), True, {}
        state, outcome = program(snapshot.state(), frames, step - snapshot.step)
        return state, bool(outcome.finite), outcome.metrics

    good, bad = good_step, bad_step
    if replay(bad)[1]:
        detail = (
            f"a step up to {bad_step:,} was not finite, but was when it was repeated"
        )
        state, finite, _ = replay(good)
        return (state, good, detail) if finite else (*_contents(snapshot), detail)
    while bad - good > 1:
        middle = (good + bad) // 2
        if replay(middle)[1]:
            good = middle
        else:
            bad = middle
    state, _, metrics = replay(bad)
    names = [f"metric {name}" for name, x in metrics.items() if not np.isfinite(x)]
    detail = f"step {bad:,} is not finite: {join_names(names + bad_arrays(state))}"
    return replay(good)[0], good, detail


def _contents(snapshot):
    return snapshot.state(), snapshot.step


def join_names(names):
    """Join the first few of several names.

    Args:
      names: Names.

    Returns:
      Up to four names, and the number of further ones.
    """
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if names[4:] else "")


def bad_arrays(state):
    """Find the arrays of a state that are not finite.

    Args:
      state: Training state.

    Returns:
      A line for each, with its path and the number of its values that are not finite.
    """
    descriptions = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]:
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            continue
        bad = ~np.isfinite(np.asarray(leaf))
        if bad.any():
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            descriptions.append(f"{name} ({bad.sum():,} of {bad.size:,} values)")
    return descriptions
