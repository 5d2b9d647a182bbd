"""Linear functions with a custom transpose, differentiable in forward and reverse mode.

`jax.custom_vjp` refuses forward mode, and the rule of a `jax.custom_jvp` has to be
transposed by JAX, which cannot transpose a `while_loop`.
`jax.custom_derivatives.linear_call` closes that gap, but it has no batching rule and no
derivative with respect to its residuals, which Hessian-vector products need.
"""

import dataclasses
import functools
from collections.abc import Callable, Hashable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

PyTree = Any
Linear = Callable[[Hashable, PyTree, Array], Array]


def linear_call(
    function: Linear,
    transpose: Linear,
    settings: Hashable,
    residuals: PyTree,
    argument: Float[Array, "..."],
) -> Float[Array, "..."]:
    """Compute `function(settings, residuals, argument)`, with a custom transpose.

    The call may be batched, transposed and differentiated in forward mode, also with
    respect to `residuals`. A `jax.custom_jvp` rule that ends in it therefore has both
    modes, and forward over reverse. Derivatives with respect to `residuals` in reverse
    mode exist where JAX can transpose the functions themselves.

    Args:
      function: Linear in its last argument. Define it at module level, so that equal
        calls share a compiled program.
      transpose: Takes a cotangent of the result in place of `argument`, and returns the
        cotangent of `argument`.
      settings: Static argument of both functions.
      residuals: Arrays in which the functions need not be linear.
      argument: Array in which they are.

    Returns:
      The result of `function`.
    """
    leaves, tree = jax.tree.flatten(residuals)
    pair = _Pair(function, transpose, settings, tree)
    return _linear_call.bind(*leaves, argument, pair=pair)


@dataclasses.dataclass(frozen=True)
class _Pair:
    """A linear function of flat arguments, and its transpose."""

    function: Linear
    transpose: Linear
    settings: Hashable
    tree: Any
    # For each batch axis, innermost first: which residuals have it as first axis.
    batched: tuple[tuple[bool, ...], ...] = ()

    def __call__(self, *arrays):
        def call(leaves, argument):
            residuals = jax.tree.unflatten(self.tree, leaves)
            return self.function(self.settings, residuals, argument)

        for mask in self.batched:
            call = jax.vmap(
                call, ([0 if is_batched else None for is_batched in mask], 0)
            )
        *leaves, argument = arrays
        return call(leaves, argument)

    def swapped(self) -> "_Pair":
        return dataclasses.replace(
            self, function=self.transpose, transpose=self.function
        )


_linear_call = Primitive("linear_call_with_transpose")


@functools.partial(jax.jit, static_argnums=0)
def _run_compiled(pair, *arrays):
    return pair(*arrays)


def _run(*arrays, pair):
    return _run_compiled(pair, *arrays)


def _shape(*arrays, pair):
    shapes = (jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays)
    result = _run_compiled.eval_shape(pair, *shapes)
    return jax.core.ShapedArray(result.shape, result.dtype)


def _jvp(primals, tangents, *, pair):
    *residual_tangents, argument_tangent = tangents
    if any(type(tangent) is not ad.Zero for tangent in residual_tangents):
        dense = tuple(ad.instantiate_zeros(tangent) for tangent in tangents)
        return jax.jvp(pair, tuple(primals), dense)
    result = _linear_call.bind(*primals, pair=pair)
    tangent = ad.instantiate_zeros(argument_tangent)
    return result, _linear_call.bind(*primals[:-1], tangent, pair=pair)


def _transpose(cotangent, *arrays, pair):
    *leaves, _ = arrays
    cotangent = ad.instantiate_zeros(cotangent)
    result = _linear_call.bind(*leaves, cotangent, pair=pair.swapped())
    return [None] * len(leaves) + [result]


def _batch(arrays, axes, *, pair):
    size = next(x.shape[a] for x, a in zip(arrays, axes, strict=True) if a is not None)
    first = [
        x if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arrays, axes, strict=True)
    ]
    if axes[-1] is None:
        # Otherwise the transpose would sum over an axis that only residuals have.
        first[-1] = jnp.broadcast_to(first[-1], (size, *first[-1].shape))
    mask = tuple(axis is not None for axis in axes[:-1])
    pair = dataclasses.replace(pair, batched=(*pair.batched, mask))
    return _linear_call.bind(*first, pair=pair), 0


_linear_call.def_impl(_run)
_linear_call.def_abstract_eval(_shape)
ad.primitive_jvps[_linear_call] = _jvp
ad.primitive_transposes[_linear_call] = _transpose
batching.primitive_batchers[_linear_call] = _batch
mlir.register_lowering(_linear_call, mlir.lower_fun(_run, multiple_results=False))
