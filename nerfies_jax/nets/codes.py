"""Latent tables (GLO, Bojanowski et al. 2018): one learned code for each id."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

Table = Float[Array, "ids code"]


def init(
    key: Key[Array, ""], ids: int, width: int, scale: float = 0.05, dtype=jnp.float32
) -> Table:
    """Codes drawn uniformly from [-scale, scale].

    Nerfies draws from [0, 0.05); centered, the mean code is what an unseen moment gets.
    """
    if ids < 1 or width < 1:
        raise ValueError(
            f"a code table needs ids >= 1 and width >= 1, got ids={ids}, width={width}"
        )
    drawn = jax.random.uniform(key, (ids, width), jnp.float32, -1, 1)
    return scale * drawn.astype(dtype)


def check_ids(ids: Any, count: int, name: str = "ids") -> None:
    """Raise ValueError where an id has no row in a table of `count`; on the host.

    Once, where a capture meets a model: under `jit` an id outside cannot raise.
    """
    values = np.asarray(ids)
    if not np.issubdtype(values.dtype, np.integer):
        raise ValueError(f"{name} must be whole numbers, got {values.dtype}")
    outside = (values < 0) | (values >= count)
    if outside.any():
        row = int(np.flatnonzero(outside.ravel())[0])
        raise ValueError(
            f"{name}[{row}] = {values.ravel()[row]} is not in 0 .. {count - 1}; give "
            f"the table {int(values.max()) + 1} rows, or number the ids from 0"
        )


def look_up(table: Table, index: Int[Array, ""]) -> Float[Array, " code"]:
    """The code of one id; `check_ids` has seen that it is in the table.

    An id outside is held to the nearest row. JAX would answer NaN, and a negative id
    would count from the end.
    """
    return table[jnp.clip(index, 0, table.shape[0] - 1)]


def blend(
    table: Table,
    left: Int[Array, ""],
    right: Int[Array, ""],
    progress: Float[Array, ""],
) -> Float[Array, " code"]:
    """The code between two ids: the left one at progress 0, the right one at 1."""
    start, end = look_up(table, left), look_up(table, right)
    # Not start + progress (end - start), which does not quite arrive at 1.
    return (1 - progress) * start + progress * end


def at_time(table: Table, time: Float[Array, ""]) -> Float[Array, " code"]:
    """The code at a time in [0, 1], over a table whose rows are moments in order.

    Piecewise linear between rows; times outside are held to the ends.
    """
    place = jnp.clip(time, 0, 1) * (table.shape[0] - 1)
    left = jnp.clip(jnp.floor(place), 0, max(table.shape[0] - 2, 0))
    index = left.astype(jnp.int32)
    return blend(table, index, index + 1, place - left)


def at_time_of(
    table: Table, rows: Float[Array, ""], time: Float[Array, ""]
) -> Float[Array, " code"]:
    """As `at_time`, of the table resampled to so many rows first; `rows` at least 2.

    Ends stay ends. With as many rows as it has, or more, it is the table itself. The
    number may be traced: nothing is made of that size. E-D3DGS, arXiv:2404.03613,
    reads its codes so.
    """
    rows = jnp.clip(rows, min(2, table.shape[0]), table.shape[0])
    last = jnp.maximum(rows - 1, 1)
    place = jnp.clip(time, 0, 1) * last
    left = jnp.clip(jnp.floor(place), 0, last - 1)
    progress = place - left
    start, end = (at_time(table, row / last) for row in (left, left + 1))
    return (1 - progress) * start + progress * end
