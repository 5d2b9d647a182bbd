"""Spacing and neighbors of the training timestamps."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def interval(count: int) -> float:
    """Return the time between two of evenly spaced timestamps in [0, 1].

    Args:
      count: Number of timestamps.

    Returns:
      The interval, 2 for a single timestamp, which has no neighbors.

    Raises:
      ValueError: If there are none.
    """
    if count < 1:
        raise ValueError(f"count={count} must be at least 1 timestamp")
    return 1 / (count - 1) if count > 1 else 2.0


def neighbor(
    times: tuple[float, ...] | Float[Array, " times"],
    time: Float[Array, " rays"],
    sign: int,
) -> tuple[Float[Array, " rays"], Bool[Array, " rays"]]:
    """Find the training timestamp after or before the one nearest to a time.

    Args:
      times: Training timestamps in ascending order.
      time: Times, [rays].
      sign: 1 for the next timestamp, -1 for the previous one.

    Returns:
      Timestamps [rays], one interval away if there is none, and booleans [rays] that
      are True if there is one.
    """
    timestamps = jnp.asarray(times, time.dtype)
    midpoints = (timestamps[1:] + timestamps[:-1]) / 2
    index = jnp.searchsorted(midpoints, time) + sign
    present = (index >= 0) & (index < len(times))
    nearest = timestamps[jnp.clip(index, 0, len(times) - 1)]
    extrapolation = time + sign * interval(len(times))
    return jnp.where(present, nearest, extrapolation), present
