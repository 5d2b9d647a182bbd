"""Which Gaussians move at all, and the pose of those alone.

Most of a filmed scene stands still, and a deformation network finds that out anew for
every Gaussian at every instant. `split` asks once, on the host, at a few instants; from
then on `pose` evaluates the deformation of the rows that move and of no other.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gaussians_jax import splats
from gaussians_jax.splats import Gaussians, Params
from nerfies_jax.geometry import quaternion

# The pose of any choice of rows: (parameters of those rows, time) -> Gaussians.
PoseRows = Callable[[Params, Float[Array, ""]], Gaussians]


class Where(NamedTuple):
    """For each row, whether it moves, and then where it is among those that do."""

    moves: Bool[Array, " gaussians"]
    place: Int[Array, " gaussians"]  # 0 where it does not move


class Split(NamedTuple):
    """A trained scene, its moving rows apart from those that stand still."""

    still: Gaussians  # all rows, as they are at the middle instant
    where: Where
    moving: Params  # the parameters of the rows that move, and all networks


def reach(before: Gaussians, after: Gaussians) -> Float[Array, " gaussians"]:
    """How far the surface of each Gaussian moves at most; scene units.

    A point of the one-sigma ellipsoid, mean + R S u with |u| = 1, moves by no more than
    |Δmean| + max |ΔS| + 2 sin(θ/2) max S, with θ the angle between the rotations and S
    the scales before. Equality for a translation or a growth; an upper bound for a
    turn, which a round Gaussian does not show. Made for choosing rows, not for
    differentiating: its slope is undefined where nothing moves.
    """
    shift = jnp.linalg.norm(after.mean - before.mean, axis=-1)
    growth = jnp.max(jnp.abs(after.scale - before.scale), axis=-1)
    widest = jnp.max(jnp.abs(before.scale), axis=-1)
    first, second = (
        jax.vmap(quaternion.normalise)(g.quaternion) for g in (before, after)
    )
    # |q - q'| = 2 sin(θ/4) for the nearer sign: 1 - q·q' would lose small angles.
    apart = jnp.minimum(
        jnp.linalg.norm(second - first, axis=-1),
        jnp.linalg.norm(second + first, axis=-1),
    )
    chord = 2 * apart * jnp.sqrt(jnp.maximum(1 - apart**2 / 4, 0))
    return shift + growth + chord * widest


def where(moves: np.ndarray) -> Where:
    """The table of the rows that move, `moves` [gaussians] bool; host side."""
    place = np.where(moves, np.cumsum(moves) - 1, 0)
    return Where(jnp.asarray(moves), jnp.asarray(place, jnp.int32))


def moving(still: Gaussians, now: Gaussians, still_below: float) -> np.ndarray:
    """[gaussians] bool: the rows that reach farther than `still_below`; host side.

    A row that is not drawn, of opacity zero, does not move.
    """
    if not still_below >= 0:
        raise ValueError(
            f"still_below={still_below} is a distance in scene units; it cannot be "
            "negative (0 keeps every row that moves at all)"
        )
    # "not <=": a row whose motion is not a number is not taken for still.
    far = ~(np.asarray(_reach(still, now)) <= still_below)
    return far & (np.asarray(still.opacity) > 0)


def split(
    params: Params, pose: PoseRows, times: np.ndarray, still_below: float
) -> Split:
    """The rows that move farther than `still_below` (scene units); host side.

    `times` [instants] lie in [0, 1]. Rows are compared with where they are at the
    middle one, and drawn there from then on: at `times` no point of a Gaussian is
    farther than `still_below` from where the whole deformation puts it. Between them
    nothing is promised: a row that moves only between two instants has not been met.
    """
    if not len(times):
        raise ValueError("no times to look for motion at; 16 over [0, 1] will do")
    dtype = params.rows["splats"].mean.dtype
    posed = jax.jit(pose)
    still = posed(params, jnp.asarray(times[len(times) // 2], dtype))
    moves = np.zeros(len(still.mean), bool)
    for time in times:
        now = posed(params, jnp.asarray(time, dtype))
        moves |= moving(still, now, still_below)
    rows = jnp.asarray(np.flatnonzero(moves), jnp.int32)
    return Split(still, where(moves), splats.take_rows(params, rows))


def pose(parts: Split, pose_rows: PoseRows, time: Float[Array, ""]) -> Gaussians:
    """All Gaussians at one time, the deformation evaluated for those that move."""
    if not len(parts.moving.rows["splats"].mean):
        return parts.still
    return merge(parts.still, pose_rows(parts.moving, time), parts.where)


def merge(still: Gaussians, moved: Gaussians, table: Where) -> Gaussians:
    """The rows that move as in `moved`, which holds nothing else, the others still."""

    def leaf(still, moved):
        # A gather, not a scatter: XLA:CPU runs a scatter row by row.
        moves = table.moves.reshape(-1, *[1] * (still.ndim - 1))
        return jnp.where(moves, moved[table.place], still)

    return jax.tree.map(leaf, still, moved)


_reach = jax.jit(reach)
