"""One step of descent, with a learning rate for each part of the parameters."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Key

PyTree = Any
LAST_RATE = 0.02  # of a descent's first


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


def descended(
    loss: Callable[[PyTree, Key[Array, ""]], Array],
    start: PyTree,
    rates: PyTree,
    key: Key[Array, ""],
    steps: int,
) -> PyTree:
    """What Adam on `loss(params, key)` leads to, a key for each step.

    `rates`, a prefix of `start`, fall exponentially to `LAST_RATE` of the first.
    """
    adam = optax.scale_by_adam()

    def step(state, key_and_count):
        params, moments = state
        key, count = key_and_count
        grads = jax.grad(loss)(params, key)
        updates, moments = adam.update(grads, moments)
        share = LAST_RATE ** (count.astype(jnp.result_type(float)) / steps)
        now = jax.tree.map(lambda rate: rate * share, rates)
        return (apply_updates(params, updates, now), moments), None

    @jax.jit
    def run(params):
        keys = jax.random.split(key, steps), jnp.arange(steps)
        (params, _), _ = jax.lax.scan(step, (params, adam.init(params)), keys)
        return params

    # optax raises floats to a whole number of steps.
    with jax.numpy_dtype_promotion("standard"):
        return run(start)
