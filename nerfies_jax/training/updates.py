"""Gradient descent steps with learning rates per group of parameters."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Key

from nerfies_jax.training import programs

PyTree = Any
LAST_RATE = 0.02  # last over first learning rate in `minimize`


def apply_updates(params: PyTree, updates: PyTree, learning_rates: PyTree) -> PyTree:
    """Return `params - learning_rate * update`, computed in the precision of each leaf.

    Args:
      params: A pytree of arrays.
      updates: Updates of the same structure.
      learning_rates: A tree prefix of `params`.

    Returns:
      The updated parameters.
    """

    def update_group(learning_rate, group, group_updates):
        def subtract(parameter, update):
            rate = jnp.asarray(learning_rate, parameter.dtype)
            return parameter - rate * update.astype(parameter.dtype)

        return jax.tree.map(subtract, group, group_updates)

    return jax.tree.map(update_group, learning_rates, params, updates)


def minimize(
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
      rates: Initial learning rates, a tree prefix of `start`. They decay exponentially
        by the factor `LAST_RATE`.
      key: PRNG key, split into one for each step.
      steps: Number of steps.

    Returns:
      The parameters after the last step.
    """
    adam = optax.scale_by_adam()

    # Numbers and arrays of the capture are arguments, so that other captures reuse the
    # compiled program.
    @jax.jit
    def run(params, rates, key, constants):
        def step(state, key_and_count):
            params, moments = state
            key, count = key_and_count
            grads = jax.grad(lambda params: separate(constants, params, key))(params)
            updates, moments = adam.update(grads, moments)
            decay = LAST_RATE ** (count.astype(jnp.result_type(float)) / steps)
            step_rates = jax.tree.map(lambda rate: rate * decay, rates)
            return (apply_updates(params, updates, step_rates), moments), None

        keys = jax.random.split(key, steps), jnp.arange(steps)
        (params, _), _ = jax.lax.scan(step, (params, adam.init(params)), keys)
        return params

    # optax raises floats to an integer number of steps.
    with jax.numpy_dtype_promotion("standard"):
        separate, constants = programs.with_captured(loss, start, key)
        return run(start, rates, key, constants)
