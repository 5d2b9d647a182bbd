"""Gradient descent steps with a learning rate for each part of the parameters."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Key

PyTree = Any
LAST_RATE = 0.02  # of a descent's first


def apply_updates(params: PyTree, updates: PyTree, learning_rates: PyTree) -> PyTree:
    """Return `params - learning_rate * update`, each leaf in its own precision.

    Args:
      params: A pytree of arrays.
      updates: Updates of the same structure.
      learning_rates: A prefix of `params`, whose rates apply to everything below them.

    Returns:
      The updated parameters.
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
    """Minimize a loss with Adam.

    Args:
      loss: Function of parameters and a PRNG key.
      start: Initial parameters.
      rates: First learning rates, a prefix of `start`. They decay exponentially to
        `LAST_RATE` of these.
      key: PRNG key, split into one for each step.
      steps: Number of steps.

    Returns:
      The parameters after the last step.
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
