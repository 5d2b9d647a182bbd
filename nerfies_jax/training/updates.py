"""One step of descent, with a learning rate for each part of the parameters."""

from typing import Any

import jax
import jax.numpy as jnp

PyTree = Any


def apply_updates(params: PyTree, updates: PyTree, learning_rates: PyTree) -> PyTree:
    """`params - learning_rate * update`, each leaf in its own precision.

    `learning_rates` is a prefix of `params`: a rate serves everything below it.
    """

    def below(learning_rate, part, part_updates):
        def move(parameter, update):
            here = jnp.asarray(learning_rate, parameter.dtype)
            return parameter - here * update.astype(parameter.dtype)

        return jax.tree.map(move, part, part_updates)

    return jax.tree.map(below, learning_rates, params, updates)
