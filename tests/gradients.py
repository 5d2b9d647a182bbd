"""Gradient checks against central differences, which share no code with autodiff."""

import jax
import jax.numpy as jnp
import numpy as np


def directional_error(function, *args, seed=0, directions=4, step=1e-5):
    """Worst relative error of `jax.grad` along random directions, in float64.

    `function` returns a scalar; every array in `args` is differentiated. The error is
    |g.d - central difference| over the larger of |g.d|, |g|/sqrt(n) and 1e-12, so a
    direction almost orthogonal to the gradient does not blow it up.
    """
    leaves, tree = jax.tree.flatten(args)
    leaves = [np.asarray(leaf) for leaf in leaves]  # by NumPy: nothing to compile
    flat = np.concatenate([leaf.ravel() for leaf in leaves])
    if flat.dtype != np.float64:
        raise TypeError(f"gradient checks need float64 inputs, got {flat.dtype}")
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]

    @jax.jit
    def along(x):
        parts = zip(jnp.split(x, ends), leaves, strict=True)
        return function(*tree.unflatten([one.reshape(of.shape) for one, of in parts]))

    gradient = np.asarray(jax.jit(jax.grad(along))(flat))
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(directions):
        direction = rng.normal(size=flat.shape)
        direction /= np.linalg.norm(direction)
        difference = float(along(flat + step * direction))
        difference = (difference - float(along(flat - step * direction))) / (2 * step)
        grad = gradient @ direction
        scale = max(abs(grad), np.linalg.norm(gradient) / np.sqrt(flat.size), 1e-12)
        errors.append(abs(difference - grad) / scale)
    return float(np.max(errors))  # unlike the built-in max it keeps NaN
