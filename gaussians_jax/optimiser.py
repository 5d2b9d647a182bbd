"""Adam that counts per row, and the one gather that moves rows and their moments."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Int

from gaussians_jax import splats
from gaussians_jax.splats import Params

PyTree = Any


class RowAdamState(NamedTuple):
    """Moments, and how many updates went into each row of them."""

    count: PyTree  # int32, [capacity] for every leaf
    first: PyTree
    second: PyTree


def scale_by_row_adam(
    b1: float = 0.9, b2: float = 0.999, eps: float = 1e-15
) -> optax.GradientTransformation:
    """Adam (Kingma and Ba, arXiv:1412.6980) with one step count for each row.

    For parameters that all have one row per Gaussian. The moments of a row born late
    start at zero like everyone's, and so does its count. Under one shared count of 1000
    its first five updates are 2.5, 3.4, 3.9, 4.3 and 4.6 times too large for a steady
    gradient, which is what reference implementations run. For the same reason a row
    starts to count at its first slope that is not zero: harmonics that are switched on
    late and networks that wait for a warm-up to end start like everyone else. `eps` is
    that of 3D Gaussian splatting: 1e-8 would halve the steps where gradients are 1e-8.
    """

    def init(params):
        def count(leaf):
            return jnp.zeros(leaf.shape[:1], jnp.int32)

        zeros = jax.tree.map(jnp.zeros_like, params)
        return RowAdamState(jax.tree.map(count, params), zeros, zeros)

    def update(updates, state, params=None):
        del params
        count = jax.tree.map(_count_once_started, state.count, updates)
        first = jax.tree.map(lambda g, m: b1 * m + (1 - b1) * g, updates, state.first)
        second = jax.tree.map(
            lambda g, v: b2 * v + (1 - b2) * g * g, updates, state.second
        )

        def step(n, m, v):
            # A row that has not started has zero moments: any age will do but zero.
            age = (
                jnp.maximum(n, 1).astype(m.dtype).reshape(n.shape + (1,) * (m.ndim - 1))
            )
            # 1 - b^n, which cancels in float32 for b = 0.999 and small n.
            seen = -jnp.expm1(age * math.log(b1))
            seen_sq = -jnp.expm1(age * math.log(b2))
            return (m / seen) / (jnp.sqrt(v / seen_sq) + eps)

        return jax.tree.map(step, count, first, second), RowAdamState(
            count, first, second
        )

    return optax.GradientTransformation(init, update)


def _count_once_started(count, slopes):
    moved = jnp.any(slopes.reshape(*count.shape, -1) != 0, axis=-1)
    return count + ((count > 0) | moved).astype(count.dtype)


def row_leaves(params: Params) -> Params:
    """True for every leaf that has one row per Gaussian."""
    return Params(
        rows=jax.tree.map(lambda _: True, params.rows),
        nets=jax.tree.map(lambda _: False, params.nets),
    )


def map_moments(
    optimiser: optax.GradientTransformation,
    change: Callable[[Array], Array],
    moments: PyTree,
    chosen: Params,
) -> PyTree:
    """The optimiser state with `change` applied to all that mirrors a chosen leaf.

    Which leaves those are is asked of optax, never guessed from shapes. Parts that
    `optax.partition` or `optax.masked` hides are passed over.
    """

    def hidden(node):
        return isinstance(node, optax.MaskedNode)

    def visit(moment, is_chosen):
        return change(moment) if is_chosen and not hidden(moment) else moment

    return optax.tree_utils.tree_map_params(
        optimiser, visit, moments, chosen, is_leaf=hidden
    )


def gather_rows(
    optimiser: optax.GradientTransformation,
    params: Params,
    moments: PyTree,
    rows: Int[Array, " capacity"],
    fresh: Bool[Array, " capacity"],
    dead: Bool[Array, " capacity"],
) -> tuple[Params, PyTree]:
    """Row `rows[i]` of everything becomes row i, in parameters and moments alike.

    `fresh` rows start with zero moments and a zero count; `dead` ones are buried.
    """
    taken = splats.take_rows(params, rows)
    buried = splats.bury(taken.rows["splats"], dead)
    taken = taken._replace(rows=taken.rows | {"splats": buried})

    def gather(moment):
        forget = (fresh | dead).reshape(fresh.shape + (1,) * (moment.ndim - 1))
        return jnp.where(forget, jnp.zeros_like(moment[:1]), moment[rows])

    return taken, map_moments(optimiser, gather, moments, row_leaves(params))
