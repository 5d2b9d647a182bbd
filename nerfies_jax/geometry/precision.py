"""Geometry of numbers with fewer than float32's 24 bits.

What moves a point or measures a strain is computed in float32 and rounded once at the
end: in bfloat16 arithmetic a screw is 3e-2 off. Cameras are refused, for there the
inputs themselves are too coarse.
"""

import functools

import jax
import jax.numpy as jnp

_HALVES = (jnp.dtype(jnp.bfloat16), jnp.dtype(jnp.float16))


def at_least_float32(function):
    """`function`, computed in float32 where array arguments are bfloat16 or float16.

    Results are rounded to the arguments' type where all have the same, and are float32
    otherwise. Derivatives follow: float32 inside, rounded once.
    """

    @functools.wraps(function)
    def widened(*args):
        kinds = {arg.dtype for arg in args if hasattr(arg, "dtype")}
        if not kinds.intersection(_HALVES):
            return function(*args)
        results = function(*(_widened(arg) for arg in args))
        if len(kinds) > 1:
            return results
        return jax.tree.map(lambda leaf: leaf.astype(*kinds), results)

    return widened


def refuse_half(what: str, *arrays) -> None:
    """Raise ValueError where one of `arrays` is bfloat16 or float16."""
    for array in arrays:
        if jnp.result_type(array) in _HALVES:
            raise ValueError(
                f"{what} is {array.dtype}, which holds a pixel position of 1000 to "
                f"{1024 * float(jnp.finfo(array.dtype).eps):g} px at best; cast it to "
                "float32"
            )


def _widened(arg):
    half = getattr(arg, "dtype", None) in _HALVES
    return arg.astype(jnp.float32) if half else arg
