"""Parameters far from where training starts, drawn by NumPy: nothing to compile."""

import math

import jax
import jax.numpy as jnp
import numpy as np


def like(init, dtype, size=0.2, seed=0):
    """Arrays of the shapes that `init` of a key returns: biases of `size`, no zeros."""
    rng, kind = np.random.default_rng(seed), jnp.dtype(dtype)

    def draw(leaf):
        width = size + (len(leaf.shape) > 1) / math.sqrt(leaf.shape[0])
        # Rounded by NumPy: JAX would compile a conversion for every shape.
        return jnp.asarray((width * rng.normal(size=leaf.shape)).astype(kind))

    return jax.tree.map(draw, jax.eval_shape(init, jax.random.key(0)))
