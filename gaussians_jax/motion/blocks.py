"""A function of one Gaussian's rows, evaluated a block of Gaussians at a time."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

PyTree = Any


def in_blocks(
    evaluate: Callable[..., PyTree],
    rows: tuple[PyTree, ...],
    active: Bool[Array, " gaussians"] | None,
    block: int,
) -> PyTree:
    """Evaluate `evaluate(*rows)` with the memory that `block` Gaussians need.

    `evaluate` takes and returns pytrees whose leaves have the Gaussians first. A block
    in which no row is active is not evaluated, so compacted rows do not pay for the
    capacity behind them; what it would have returned is zero. None: all are active.
    """
    count = jax.tree.leaves(rows)[0].shape[0]
    if active is None:
        active = jnp.ones(count, bool)
    block = max(1, min(block, count))
    blocks = -(-count // block)

    def cut(leaf):
        padding = [(0, blocks * block - count)] + [(0, 0)] * (leaf.ndim - 1)
        return jnp.pad(leaf, padding).reshape(blocks, block, *leaf.shape[1:])

    def static(*rows):
        return jax.tree.map(
            lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
            jax.eval_shape(evaluate, *rows),
        )

    # Recomputing a block in the backward pass keeps one block's activations, not all.
    # The loop already keeps XLA from merging the two passes.
    @functools.partial(jax.remat, prevent_cse=False)
    def one_block(rows, is_used):
        return jax.lax.cond(is_used, evaluate, static, *rows)

    pieces = jax.tree.map(cut, rows), cut(active).any(axis=1)
    outputs = jax.lax.map(lambda piece: one_block(*piece), pieces)
    return jax.tree.map(
        lambda leaf: leaf.reshape(blocks * block, *leaf.shape[2:])[:count], outputs
    )
