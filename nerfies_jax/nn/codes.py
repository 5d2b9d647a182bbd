"""Latent code tables (GLO, Bojanowski et al. 2018): one learned code for each id."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

Table = Float[Array, "ids code"]


def init(
    key: Key[Array, ""],
    ids: int,
    width: int,
    scale: float = 0.05,
    dtype: DTypeLike = jnp.float32,
) -> Table:
    """Initialize codes uniformly in [-scale, scale].

    Nerfies uses [0, 0.05). Codes centered on zero allow the mean code to be used for a
    timestamp without its own code.

    Args:
      key: PRNG key.
      ids: Number of codes.
      width: Length of a code.
      scale: Half-width of the distribution.
      dtype: Floating-point type of the table.

    Returns:
      A table [ids, width].

    Raises:
      ValueError: If `ids` or `width` is below 1.
    """
    if ids < 1 or width < 1:
        raise ValueError(
            f"a code table needs ids >= 1 and width >= 1, got ids={ids}, width={width}"
        )
    uniform = jax.random.uniform(key, (ids, width), jnp.float32, -1, 1)
    return scale * uniform.astype(dtype)


def check_ids(ids: Any, count: int, name: str = "ids") -> None:
    """Check on the host that ids are row indices of a table.

    Call it once for the capture and the model. Under `jit` an invalid id cannot raise.

    Args:
      ids: Integers of any shape.
      count: Number of rows of the table.
      name: Name of the ids in the error message.

    Raises:
      ValueError: If ids are not integers or one is outside 0 .. count - 1.
    """
    values = np.asarray(ids)
    if not np.issubdtype(values.dtype, np.integer):
        raise ValueError(f"{name} must be whole numbers, got {values.dtype}")
    outside = (values < 0) | (values >= count)
    if outside.any():
        row = int(np.flatnonzero(outside.ravel())[0])
        raise ValueError(
            f"{name}[{row}] = {values.ravel()[row]} is not in 0 .. {count - 1}; use a "
            f"table of {int(values.max()) + 1} rows, or number the ids from 0"
        )


def look_up(table: Table, index: Int[Array, ""]) -> Float[Array, " code"]:
    """Return the code of one id.

    An id outside of the table is clamped to the nearest row. JAX would return NaN, and
    a negative id would count from the end.

    Args:
      table: Codes, [ids, code].
      index: The id, which `check_ids` has checked.

    Returns:
      The code, [code].
    """
    return table[jnp.clip(index, 0, table.shape[0] - 1)]


def blend(
    table: Table,
    left: Int[Array, ""],
    right: Int[Array, ""],
    progress: Float[Array, ""],
) -> Float[Array, " code"]:
    """Interpolate linearly between the codes of two ids.

    Args:
      table: Codes, [ids, code].
      left: Id at progress 0.
      right: Id at progress 1.
      progress: Position between the two, in [0, 1].

    Returns:
      The code, [code].
    """
    start, end = look_up(table, left), look_up(table, right)
    # start + progress (end - start) would not be exact at progress 1.
    return (1 - progress) * start + progress * end


def place_of(
    places: Any, index: Int[Array, ""], dtype: Any
) -> tuple[Int[Array, ""], Int[Array, ""], Float[Array, ""]]:
    """Look up the place of an id in a table whose ids are interpolated.

    Args:
      places: For each id, two ids of the table and the progress between them: tuples,
        or an array [ids, 3].
      index: The id. One that is out of range uses the nearest one.
      dtype: Floating-point type of the progress.

    Returns:
      Left id, right id and progress, as for `blend`.
    """
    row = jnp.clip(index, 0, len(places) - 1)
    left, right, progress = jnp.asarray(places)[row]
    return left.astype(jnp.int32), right.astype(jnp.int32), progress.astype(dtype)


def at_time(table: Table, time: Float[Array, ""]) -> Float[Array, " code"]:
    """Interpolate linearly in time between the codes of a table.

    Args:
      table: Codes at evenly spaced times from 0 to 1, [ids, code].
      time: Time, clamped to [0, 1].

    Returns:
      The code [code], piecewise linear in time.
    """
    place = jnp.clip(time, 0, 1) * (table.shape[0] - 1)
    left = jnp.clip(jnp.floor(place), 0, max(table.shape[0] - 2, 0))
    index = left.astype(jnp.int32)
    return blend(table, index, index + 1, place - left)


def at_time_of(
    table: Table, rows: Float[Array, ""], time: Float[Array, ""]
) -> Float[Array, " code"]:
    """Interpolate a table along time after resampling it to fewer rows.

    The number of rows may be traced, because no array of that size is made.

    Args:
      table: Codes at evenly spaced times from 0 to 1, [ids, code].
      rows: Number of rows to resample to, at least 2. The first and last row do not
        change. With the number of rows of the table or more, nothing is resampled.
      time: Time, clamped to [0, 1].

    Returns:
      The code, [code].

    References:
      E-D3DGS, arXiv:2404.03613.
    """
    rows = jnp.clip(rows, min(2, table.shape[0]), table.shape[0])
    last = jnp.maximum(rows - 1, 1)
    place = jnp.clip(time, 0, 1) * last
    left = jnp.clip(jnp.floor(place), 0, last - 1)
    progress = place - left
    start, end = (at_time(table, row / last) for row in (left, left + 1))
    return (1 - progress) * start + progress * end
