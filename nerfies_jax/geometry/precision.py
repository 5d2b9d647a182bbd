"""Precision rules of geometry: half-precision inputs and matrix products.

Functions that transform points or compute strains work in float32 and round once at the
end. In bfloat16 arithmetic a twist has an error of 3e-2. Half-precision cameras are
refused, because their values are too coarse.

By default a TPU rounds the factors of float32 matrix products to 8 bits and a GPU to
11. On a CPU, where XLA supports it, JAX's configuration decides. Networks may use the
default. Geometry, sorting and metrics use `exact_product` and `exact_einsum`.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Num

F = TypeVar("F", bound=Callable[..., Any])

_HALVES = (jnp.dtype(jnp.bfloat16), jnp.dtype(jnp.float16))


def exact_product(
    left: Num[Array, "..."], right: Num[Array, "..."]
) -> Num[Array, "..."]:
    """Multiply matrices at full precision, whatever JAX's default precision is.

    Args:
      left: First factor, as for `jnp.matmul`.
      right: Second factor.

    Returns:
      `left @ right`.
    """
    return jnp.matmul(left, right, precision=lax.Precision.HIGHEST)


def exact_einsum(formula: str, *factors: Float[Array, "..."]) -> Float[Array, "..."]:
    """Evaluate `jnp.einsum` at full precision, whatever JAX's default precision is.

    Args:
      formula: Subscripts, as for `jnp.einsum`.
      *factors: Arrays.

    Returns:
      The sum of products.
    """
    return jnp.einsum(formula, *factors, precision=lax.Precision.HIGHEST)


def at_least_float32(function: F) -> F:
    """Compute a function in float32 if any array argument is bfloat16 or float16.

    Derivatives are treated the same way.

    Args:
      function: A function of arrays.

    Returns:
      The wrapped function. Its results are rounded to the type of the arguments if all
      have the same type, and are float32 otherwise.
    """

    @functools.wraps(function)
    def in_float32(*args, **kwargs):
        values = (*args, *kwargs.values())
        dtypes = {value.dtype for value in values if hasattr(value, "dtype")}
        if not dtypes.intersection(_HALVES):
            return function(*args, **kwargs)
        wide_kwargs = {name: _wide(arg) for name, arg in kwargs.items()}
        results = function(*(_wide(arg) for arg in args), **wide_kwargs)
        if len(dtypes) > 1:
            return results
        return jax.tree.map(lambda leaf: leaf.astype(*dtypes), results)

    return cast(F, in_float32)


def widened(values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Convert half-precision values to float32.

    Narrower types cannot count pixels or resolve variances. A masked mean over 200x180
    pixels in bfloat16 is 0.064 instead of 0.039, because the count stops at 256, and
    SSIM of equal images is -0.68. In float16 a count of 65504 pixels or more is
    infinite, which makes a mean error zero. Gradients have the type of the argument.

    Args:
      values: Array of any floating-point type.

    Returns:
      The values in float32, or unchanged if they are float32 or float64.
    """
    return values.astype(jnp.float32) if values.dtype in _HALVES else values


def near_one(
    values: Float[Array, "*shape"], axis: int | None = None
) -> tuple[Float[Array, "*shape"], Float[Array, "..."]]:
    """Divide values by the power of two nearest to their largest magnitude.

    The largest magnitude is then between 2/3 and 4, so that sums of squares stay in
    range. The division is exact. Use it for results that do not depend on the scale,
    such as directions and ratios, because the scale has no derivative. Values that
    XLA flushes to zero (below 1.2e-38 in float32) stay zero.

    Args:
      values: Array of any shape.
      axis: Axis along which the maximum is taken, None for the maximum of all values.

    Returns:
      The scaled values, and the scale. The axis is kept with length one.
    """
    largest = jnp.max(jnp.abs(values), axis=axis, keepdims=axis is not None)
    scale = power_of_two(lax.stop_gradient(largest))
    return values / scale, scale


def power_of_two(size: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the power of two nearest to a value whose reciprocal is a normal number.

    XLA:CPU divides by x by multiplying with 1 / x, which in float32 it flushes to zero
    if x is 8.5e37 or more.

    Args:
      size: Non-negative values.

    Returns:
      Powers of two of the same shape. NaN stays NaN.
    """
    limits = jnp.finfo(size.dtype)
    power = lax.reduce_precision(size, limits.nexp, 0)
    return jnp.clip(power, limits.tiny, 1 / float(limits.tiny))


def refuse_half(what: str, *arrays) -> None:
    """Refuse half-precision arrays.

    Args:
      what: Name of the arrays in the error message.
      *arrays: Arrays to check.

    Raises:
      ValueError: If one of the arrays is bfloat16 or float16.
    """
    for array in arrays:
        if jnp.result_type(array) in _HALVES:
            raise ValueError(
                f"{what} is {array.dtype}, which holds a pixel position of 1000 to "
                f"{1024 * float(jnp.finfo(array.dtype).eps):g} px at best; cast it to "
                "float32"
            )


def _wide(arg):
    return widened(arg) if getattr(arg, "dtype", None) in _HALVES else arg
