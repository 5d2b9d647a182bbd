"""Evaluation of a per-Gaussian function, one block of Gaussians at a time."""

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
    """Evaluate `evaluate(*rows)` with the memory of a block of Gaussians.

    A block without active Gaussians is not evaluated, and its output is zero. Scenes
    whose active Gaussians come first do not pay for their unused capacity.

    Args:
      evaluate: Takes and returns pytrees with the Gaussians as first axis.
      rows: Its arguments.
      active: True for active Gaussians. None: all are active.
      block: Number of Gaussians in a block.

    Returns:
      The output for all Gaussians.
    """
    count = jax.tree.leaves(rows)[0].shape[0]
    if active is None:
        active = jnp.ones(count, bool)
    block = max(1, min(block, count))
    blocks = -(-count // block)

    def cut(leaf):
        padding = [(0, blocks * block - count)] + [(0, 0)] * (leaf.ndim - 1)
        return jnp.pad(leaf, padding).reshape(blocks, block, *leaf.shape[1:])

    def zeros(*rows):
        return jax.tree.map(
            lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
            jax.eval_shape(evaluate, *rows),
        )

    # The backward pass recomputes each block, so only one block's activations are kept.
    # The loop prevents XLA from merging the two passes.
    @functools.partial(jax.remat, prevent_cse=False)
    def one_block(rows, is_used):
        return jax.lax.cond(is_used, evaluate, zeros, *rows)

    pieces = jax.tree.map(cut, rows), cut(active).any(axis=1)
    outputs = jax.lax.map(lambda piece: one_block(*piece), pieces)
    return jax.tree.map(
        lambda leaf: leaf.reshape(blocks * block, *leaf.shape[2:])[:count], outputs
    )
