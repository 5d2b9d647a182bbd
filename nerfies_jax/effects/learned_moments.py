"""The moments that a capture is learned from: how far apart, which lies beside one."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


def interval(moments: int) -> float:
    """Time from one of so many moments to the next; a single one has no neighbors."""
    if moments < 1:
        raise ValueError(f"a capture has at least one moment, got moments={moments}")
    return 1 / (moments - 1) if moments > 1 else 2.0


def beside(
    times: tuple[float, ...], time: Float[Array, " rays"], sign: int
) -> tuple[Float[Array, " rays"], Bool[Array, " rays"]]:
    """The learned moment after (1) or before (-1) the one nearest to a time.

    The second is whether there is one; where there is none, the first is an interval
    away.
    """
    known = np.asarray(times)
    between = jnp.asarray((known[1:] + known[:-1]) / 2, time.dtype)
    place = jnp.searchsorted(between, time) + sign
    present = (place >= 0) & (place < len(times))
    beside = jnp.asarray(known, time.dtype)[jnp.clip(place, 0, len(times) - 1)]
    away = time + sign * interval(len(times))
    return jnp.where(present, beside, away), present
