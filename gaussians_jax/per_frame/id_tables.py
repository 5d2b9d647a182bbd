"""Tables with a row for each appearance id, as deviations from their mean."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nerfies_jax.nn import codes

# For each appearance id, two row indices and the interpolation weight of the second, as
# in `nerfies_jax.capture.scene_metadata.exposures`.
Places = tuple[tuple[int, int, float], ...] | Float[Array, "appearances 3"]


def rows_of(places: Places) -> int:
    """Return the number of rows of a table: the number of trained ids.

    Args:
      places: Interpolation of all ids between trained ones.

    Returns:
      The number.
    """
    return 1 + max(max(left, right) for left, right, _ in places)


def deviation(
    table: Float[Array, "ids width"], places: Places, appearance: Int[Array, ""]
) -> Float[Array, " width"]:
    """Look up the row of an appearance id, minus the mean of all rows.

    The mean is treated as constant, because a gradient through it would reach all other
    frames, and Adam normalizes even the smallest gradients. Untrained ids are
    interpolated. An unknown id uses the nearest one.

    Args:
      table: A row for each trained id.
      places: Interpolation of untrained ids.
      appearance: Appearance id.

    Returns:
      The deviation.
    """
    deviations = table - jax.lax.stop_gradient(jnp.mean(table, axis=0))
    place = codes.place_of(places, appearance, table.dtype)
    return codes.blend(deviations, *place)
