"""Separation of moving from static Gaussians, so that only the former are deformed.

Most of a scene is static, and a deformation network would evaluate every Gaussian at
every time. `split` evaluates it once, on the host, at a few times. From then on
`deform` evaluates the moving Gaussians only.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Gaussians, Params
from nerfies_jax.geometry import quaternion

FADES = 1 / 512  # change of opacity that is invisible in 8-bit images
# The deformation of any choice of rows: (parameters of those rows, time) -> Gaussians.
DeformRows = Callable[[Params, Float[Array, ""]], Gaussians]


class RowIndex(NamedTuple):
    """Index of each Gaussian among the moving ones, and whether it moves."""

    moves: Bool[Array, " gaussians"]
    place: Int[Array, " gaussians"]  # 0 where it does not move


class StaticDynamicSplit(NamedTuple):
    """A trained scene with moving and static Gaussians separated."""

    static: Gaussians  # all Gaussians at the middle time
    row_index: RowIndex
    dynamic: Params  # the parameters of the rows that move, and all networks


def max_displacement(before: Gaussians, after: Gaussians) -> Float[Array, " gaussians"]:
    """Bound the displacement of the surface of each Gaussian.

    A point of the one-sigma ellipsoid, mean + R S u with |u| = 1, moves by no more than
    |Δmean| + max |ΔS| + 2 sin(θ/2) max S, where θ is the angle between the rotations
    and S are the scales before. The bound is exact for a translation or a change of
    scale. It is an upper bound for a rotation, which is invisible on an isotropic
    Gaussian. Its gradient is undefined where nothing moves.

    Args:
      before: Gaussians.
      after: The same Gaussians at another time.

    Returns:
      Displacement in scene units.
    """
    shift = jnp.linalg.norm(after.mean - before.mean, axis=-1)
    growth = jnp.max(jnp.abs(after.scale - before.scale), axis=-1)
    widest = jnp.max(jnp.abs(before.scale), axis=-1)
    first, second = (
        jax.vmap(quaternion.normalize)(g.quaternion) for g in (before, after)
    )
    # |q - q'| = 2 sin(θ/4) for the nearer sign. 1 - q·q' would lose small angles.
    difference = jnp.minimum(
        jnp.linalg.norm(second - first, axis=-1),
        jnp.linalg.norm(second + first, axis=-1),
    )
    chord = 2 * difference * jnp.sqrt(jnp.maximum(1 - difference**2 / 4, 0))
    return shift + growth + chord * widest


def row_index(moves: np.ndarray) -> RowIndex:
    """Index the moving Gaussians, on the host.

    Args:
      moves: [gaussians] bool.

    Returns:
      The index.
    """
    index = np.where(moves, np.cumsum(moves) - 1, 0)
    return RowIndex(jnp.asarray(moves), jnp.asarray(index, jnp.int32))


def dynamic_mask(
    static: Gaussians, now: Gaussians, static_threshold: float
) -> np.ndarray:
    """Select the Gaussians that move farther than a threshold, on the host.

    A Gaussian with zero opacity at both times does not count as moving.

    Args:
      static: Gaussians at a reference time.
      now: The same Gaussians at another time.
      static_threshold: Threshold in scene units.

    Returns:
      [gaussians] bool.

    Raises:
      ValueError: If the threshold is negative.
    """
    if not static_threshold >= 0:
        raise ValueError(
            f"static_threshold={static_threshold} is a distance in scene units; it "
            "cannot be negative (0 keeps every row that moves at all)"
        )
    # "not <=" also selects a Gaussian whose displacement is NaN.
    moves = ~(np.asarray(_max_displacement(static, now)) <= static_threshold)
    visible = (np.asarray(static.opacity) > 0) | (np.asarray(now.opacity) > 0)
    return moves & visible


def split(
    params: Params,
    deform: DeformRows,
    times: np.ndarray,
    static_threshold: float,
    fading: bool = True,
) -> StaticDynamicSplit:
    """Separate moving from static Gaussians, on the host.

    The static state of a Gaussian is its state at the middle time. At all `times`, no
    point of a static Gaussian is farther than `static_threshold` from its deformed
    position. A Gaussian that moves only between two of the times is not detected.

    Args:
      params: Trained parameters.
      deform: The deformation.
      times: Normalized times in [0, 1].
      static_threshold: Threshold in scene units.
      fading: Count Gaussians whose opacity changes by more than `FADES` as moving.

    Returns:
      The separated scene.

    Raises:
      ValueError: If there are no times or the threshold is negative.
    """
    if not len(times):
        raise ValueError("times is empty; 16 times over [0, 1] are enough")
    dtype = params.rows["splats"].mean.dtype
    compiled_deform = jax.jit(deform)
    static = compiled_deform(params, jnp.asarray(times[len(times) // 2], dtype))
    moves = np.zeros(len(static.mean), bool)
    for time in times:
        now = compiled_deform(params, jnp.asarray(time, dtype))
        moves |= dynamic_mask(static, now, static_threshold)
        if fading:
            moves |= ~(np.abs(np.asarray(now.opacity - static.opacity)) <= FADES)
    parent_moves = of_rows(params, moves)
    rows = jnp.asarray(np.flatnonzero(parent_moves), jnp.int32)
    moves = np.repeat(parent_moves, len(moves) // len(parent_moves))
    return StaticDynamicSplit(static, row_index(moves), splats.take_rows(params, rows))


def of_rows(params: Params, rendered: np.ndarray) -> np.ndarray:
    """Select the Gaussians of which any child is selected, on the host.

    Args:
      params: Trained parameters.
      rendered: [children] bool, with the children of one parent consecutive.

    Returns:
      [gaussians] bool; `rendered` itself if Gaussians have no children.
    """
    by_row = np.asarray(rendered).reshape(len(params.rows["splats"].mean), -1)
    return np.any(by_row, axis=1)


def deform(
    parts: StaticDynamicSplit, deform_rows: DeformRows, time: Float[Array, ""]
) -> Gaussians:
    """Evaluate the deformation at one time, for the moving Gaussians only.

    Args:
      parts: The separated scene.
      deform_rows: The deformation.
      time: Normalized time in [0, 1].

    Returns:
      All Gaussians.
    """
    if not len(parts.dynamic.rows["splats"].mean):
        return parts.static
    return merge(parts.static, deform_rows(parts.dynamic, time), parts.row_index)


def merge(static: Gaussians, dynamic: Gaussians, table: RowIndex) -> Gaussians:
    """Combine moving and static Gaussians.

    Args:
      static: All Gaussians at the reference time.
      dynamic: The moving Gaussians.
      table: Index of the moving Gaussians.

    Returns:
      All Gaussians.
    """

    def leaf(static, dynamic):
        # A gather, because XLA on CPUs executes a scatter row by row.
        moves = table.moves.reshape(-1, *[1] * (static.ndim - 1))
        return jnp.where(moves, dynamic[table.place], static)

    return jax.tree.map(leaf, static, dynamic)


_max_displacement = jax.jit(max_displacement)
