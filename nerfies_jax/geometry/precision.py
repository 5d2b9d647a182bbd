"""Geometry of numbers with fewer than float32's 24 bits.

What moves a point or measures a strain is computed in float32 and rounded once at the
end: in bfloat16 arithmetic a screw is 3e-2 off. Cameras are refused, for there the
inputs themselves are too coarse.

Matrix products of float32 round their factors to 8 bits by a TPU's default, to 11 by a
GPU's, and on a CPU to what JAX's switch says where XLA takes it. Networks may; what
places, moves, orders or measures goes through `exact_product` and `exact_einsum`.
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
    """`jnp.matmul` with all digits of its factors, whatever the default of products."""
    return jnp.matmul(left, right, precision=lax.Precision.HIGHEST)


def exact_einsum(formula: str, *factors: Float[Array, "..."]) -> Float[Array, "..."]:
    """`jnp.einsum` with all digits of its factors, whatever the default of products."""
    return jnp.einsum(formula, *factors, precision=lax.Precision.HIGHEST)


def at_least_float32(function: F) -> F:
    """`function`, computed in float32 where array arguments are bfloat16 or float16.

    Results are rounded to the arguments' type where all have the same, and are float32
    otherwise. Derivatives follow: float32 inside, rounded once.
    """

    @functools.wraps(function)
    def wide(*args, **kwargs):
        every = (*args, *kwargs.values())
        kinds = {arg.dtype for arg in every if hasattr(arg, "dtype")}
        if not kinds.intersection(_HALVES):
            return function(*args, **kwargs)
        wider = {name: _wide(arg) for name, arg in kwargs.items()}
        results = function(*(_wide(arg) for arg in args), **wider)
        if len(kinds) > 1:
            return results
        return jax.tree.map(lambda leaf: leaf.astype(*kinds), results)

    return cast(F, wide)


def widened(values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """At least float32: what is narrower counts pixels wrongly and loses variances.

    A masked mean over 200x180 pixels in bfloat16 reads 0.064 for 0.039, because a count
    stops at 256, SSIM of equal images -0.68; from 65504 pixels on float16 counts to
    infinity, which a PSNR takes for no error. Slopes come back in the caller's type.
    """
    return values.astype(jnp.float32) if values.dtype in _HALVES else values


def near_one(
    values: Float[Array, "*shape"], axis: int | None = None
) -> tuple[Float[Array, "*shape"], Float[Array, "..."]]:
    """`values` over the power of two next to their largest size, and that power.

    The largest comes out between 2/3 and 4, so that sums of squares stay in range, and
    no digit changes. Shares and directions do not depend on the scale: it carries no
    derivative. What XLA flushes to zero (below 1.2e-38 in float32) stays zero; the axis
    is kept, with length one.
    """
    largest = jnp.max(jnp.abs(values), axis=axis, keepdims=axis is not None)
    scale = power_of_two(lax.stop_gradient(largest))
    return values / scale, scale


def power_of_two(size: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The power of two next to `size`, of those whose reciprocals are normal numbers.

    XLA:CPU divides by x as it multiplies with 1 / x, and flushes that to zero from
    8.5e37 in float32 on. NaN stays.
    """
    limits = jnp.finfo(size.dtype)
    power = lax.reduce_precision(size, limits.nexp, 0)
    return jnp.clip(power, limits.tiny, 1 / float(limits.tiny))


def refuse_half(what: str, *arrays) -> None:
    """Raise ValueError where one of `arrays` is bfloat16 or float16."""
    for array in arrays:
        if jnp.result_type(array) in _HALVES:
            raise ValueError(
                f"{what} is {array.dtype}, which holds a pixel position of 1000 to "
                f"{1024 * float(jnp.finfo(array.dtype).eps):g} px at best; cast it to "
                "float32"
            )


def _wide(arg):
    return widened(arg) if getattr(arg, "dtype", None) in _HALVES else arg
