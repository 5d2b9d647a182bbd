"""A trained motion as a table: Gaussians at knots in time, interpolated in between.

The deformation is evaluated once per knot. A frame then reads two or four entries of a
table, whatever the network costs. The error falls with the number of knots
(docs/results/deformation_cost.md). The table takes 40 bytes (ten float32) per knot and
moving Gaussian, 13 MB for 10,000 Gaussians at 32 knots. A static Gaussian is stored
once.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from gaussians_jax.core import splats, static_rows
from gaussians_jax.core.splats import Gaussians
from gaussians_jax.core.static_rows import RowIndex
from nerfies_jax.geometry import quaternion

MIN_KNOTS = {"linear": 2, "cubic": 4}  # knots that an interpolation reads at once


class Track(NamedTuple):
    """Pose and opacity of the Gaussians at every knot."""

    mean: Float[Array, "knots moving 3"]  # scene units
    log_scale: Float[Array, "knots moving 3"]
    # Unit length, with the sign nearer to the previous knot.
    quaternion: Float[Array, "knots moving 4"]


class Knots(NamedTuple):
    """A motion over [0, 1] as a table."""

    times: Float[Array, " knots"]  # evenly spaced over [0, 1]
    track: Track  # of the moving Gaussians
    row_index: RowIndex
    static: Gaussians  # all Gaussians at the middle knot

    @property
    def bytes(self) -> int:
        """Size of the table in bytes, without the static Gaussians."""
        return sum(leaf.nbytes for leaf in self.track)


def bake(
    deform: Callable[[Float[Array, ""]], Gaussians],
    knots: int,
    static_threshold: float = 0.0,
    dtype: DTypeLike = jnp.float32,
) -> Knots:
    """Evaluate a motion at all knots, on the host.

    Args:
      deform: The motion, from a normalized time to Gaussians. It is called without
        `jax.jit`, so pass a compiled function.
      knots: Number of knots.
      static_threshold: Gaussians none of whose points moves farther than this from the
        middle knot (scene units) are stored once.
      dtype: Floating-point type of the table.

    Returns:
      The table.

    Raises:
      ValueError: If there are fewer than two knots, or opacities change over time.
    """
    if knots < MIN_KNOTS["linear"]:
        raise ValueError(
            f"knots={knots}: a table needs at least {MIN_KNOTS['linear']}, at the "
            "first and the last frame time"
        )
    times = jnp.linspace(0, 1, knots, dtype=dtype)
    frames = [jax.device_get(deform(time)) for time in times]
    static = frames[knots // 2]
    moves = np.zeros(len(static.mean), bool)
    for time, now in zip(times, frames, strict=True):
        if not np.array_equal(now.opacity, static.opacity):
            raise ValueError(
                f"the opacities at time {float(time):g} differ from those at "
                f"{float(times[knots // 2]):g}; a table of knots keeps opacities fixed,"
                " so render this motion without one"
            )
        moves |= static_rows.dynamic_mask(static, now, static_threshold)
    rows = np.flatnonzero(moves)
    tracks = [_track(jax.tree.map(lambda leaf: leaf[rows], now)) for now in frames]
    track = Track(*(jnp.stack(leaves) for leaves in zip(*tracks, strict=True)))
    track = track._replace(quaternion=_align(track.quaternion))
    static = jax.tree.map(jnp.asarray, static)
    return Knots(times, track, static_rows.row_index(moves), static)


def at(
    knots: Knots, time: Float[Array, ""], interpolation: str = "linear"
) -> Gaussians:
    """Interpolate the Gaussians at one time.

    Scales are interpolated in the logarithm and stay positive. Quaternions are
    interpolated as vectors with consistent signs and normalized. Adjacent ones are at
    most 90 degrees apart as vectors, so an interpolated one is never short.

    Args:
      knots: The table.
      time: Normalized time, clamped to [0, 1].
      interpolation: "linear" is continuous, with an error of second order in the
        distance of the knots. "cubic" (Catmull-Rom) has a continuous velocity and an
        error of third order. Both are exact at the knots, up to rounding.

    Returns:
      The Gaussians.
    """
    if not knots.track.mean.shape[1]:
        return knots.static
    start, weights = _window(knots.times, time, interpolation)

    def between(leaf):
        rows = [leaf[start + k] * weight for k, weight in enumerate(weights)]
        return sum(rows[1:], rows[0])

    mean, log_scale, turn = (between(leaf) for leaf in knots.track)
    gaussians_at = Gaussians(
        mean=mean,
        quaternion=jax.vmap(quaternion.normalize)(turn),
        scale=jnp.exp(log_scale),
        # Opacities are not interpolated. The table's are set after the merge.
        opacity=jnp.zeros_like(mean[:, 0]),
    )
    gaussians = static_rows.merge(knots.static, gaussians_at, knots.row_index)
    return gaussians._replace(opacity=knots.static.opacity)


def check(knots: int, interpolation: str) -> None:
    """Refuse a table too short for its interpolation, on the host.

    Args:
      knots: Number of knots.
      interpolation: "linear" or "cubic".

    Raises:
      ValueError: If there are too few knots, or the interpolation is unknown.
    """
    if interpolation not in MIN_KNOTS:
        raise ValueError(
            f"unknown interpolation {interpolation!r}; choose from "
            f"{', '.join(MIN_KNOTS)}"
        )
    if knots < MIN_KNOTS[interpolation]:
        raise ValueError(
            f"{interpolation} interpolation reads {MIN_KNOTS[interpolation]} knots at "
            f"once, got {knots}; use more knots or linear interpolation"
        )


def _window(
    times: Float[Array, " knots"], time: Float[Array, ""], interpolation: str
) -> tuple[Int[Array, ""], list[Float[Array, ""]]]:
    """Return the index of the first knot to read, and the weight of each knot."""
    count = times.shape[0]
    check(count, interpolation)
    clamped_time = jnp.clip(time, times[0], times[-1])
    # Searched for, because floor(time * (count - 1)) may round to the wrong interval.
    # At a knot the weights are exactly 0 and 1.
    left = jnp.searchsorted(times, clamped_time, side="right") - 1
    left = jnp.clip(left, 0, count - 2).astype(jnp.int32)
    u = (clamped_time - times[left]) / (times[left + 1] - times[left])
    if interpolation == "linear":
        return left, [1 - u, u]
    w0, w1, w2, w3 = catmull_rom(u)
    # In the first and the last interval the missing knot is extrapolated by the
    # parabola through three knots, 3a - 3b + c: its weight is added to those three.
    is_first, is_last = left == 0, left == count - 2
    start = jnp.clip(left - 1, 0, count - 4)
    zero = jnp.zeros_like(u)
    at_first = w1 + 3 * w0, w2 - 3 * w0, w3 + w0, zero
    at_last = zero, w0 + w3, w1 - 3 * w3, w2 + 3 * w3
    inside = w0, w1, w2, w3
    weights = [
        jnp.where(is_first, begin, jnp.where(is_last, end, middle))
        for begin, end, middle in zip(at_first, at_last, inside, strict=True)
    ]
    return start, weights


def catmull_rom(
    u: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Compute the Catmull-Rom weights of four evenly spaced knots.

    Args:
      u: Position between the middle two knots, in [0, 1].

    Returns:
      Four weights that sum to one, exactly those of one knot at 0 and 1.

    References:
      Catmull and Rom 1974, with tension 1/2.
    """
    return (
        u * (u * (2 - u) - 1) / 2,
        (u * u * (3 * u - 5) + 2) / 2,
        u * (u * (4 - 3 * u) + 1) / 2,
        u * u * (u - 1) / 2,
    )


def spline_weights(knots: int, time: Float[Array, ""]) -> Float[Array, " knots"]:
    """Compute the weights of evenly spaced knots over [0, 1] in a Catmull-Rom spline.

    The weights and their derivative are continuous. The end knots are repeated beyond
    the ends. All weights are returned, of which four are nonzero: a product with a
    table of few knots is cheaper than a gather of four columns, whose gradient is a
    scatter.

    Args:
      knots: Number of knots.
      time: Normalized time, clamped to [0, 1].

    Returns:
      Weights that sum to one.
    """
    last = knots - 1
    position = jnp.clip(time, 0, 1) * last
    left = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, last - 1)
    offset = position - left.astype(position.dtype)
    rows = jnp.clip(left + jnp.arange(-1, 3, dtype=jnp.int32), 0, last)
    weights = jnp.stack(catmull_rom(offset))
    return jnp.zeros(knots, position.dtype).at[rows].add(weights)


@jax.jit
def _track(gaussians):
    """Convert Gaussians to table entries."""
    # The absolute value, because a motion may make a scale negative.
    scale = jnp.clip(jnp.abs(gaussians.scale), *np.exp(splats.LOG_SCALE_RANGE).tolist())
    return Track(
        gaussians.mean,
        jnp.log(scale),
        jax.vmap(quaternion.normalize)(gaussians.quaternion),
    )


@jax.jit
def _align(turns):
    """Choose the sign of each quaternion that is nearer to the previous knot."""

    def step(before, turn):
        same_sign = jnp.sum(before * turn, axis=-1, keepdims=True) >= 0
        turn = jnp.where(same_sign, turn, -turn)
        return turn, turn

    return jax.lax.scan(step, turns[0], turns)[1]
