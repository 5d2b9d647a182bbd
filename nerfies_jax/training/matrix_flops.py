"""FLOPs of the matrix products in a function, with all iterations of loops."""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
from jax.extend import core

from nerfies_jax.nn import dense


class Counted(NamedTuple):
    """FLOPs of one call."""

    flops: float  # two for each multiply-add
    # True if there is a loop whose number of iterations depends on data. Its body is
    # counted once.
    at_least: bool


def count(function: Callable, *args: Any) -> Counted:
    """Count the operations of the matrix products of a function, without running it.

    XLA counts the body of a loop once, even if the number of iterations is known, as in
    `lax.map` over blocks of Gaussians. Of the branches of a conditional the most
    expensive one is counted. Unused results are not counted.

    Args:
      function: The function.
      *args: Its arguments.

    Returns:
      The count.
    """
    return _of_jaxpr(jax.make_jaxpr(function)(*args).jaxpr)


def _of_jaxpr(jaxpr) -> Counted:
    flops, at_least = 0.0, False
    read = _variables(jaxpr.outvars)
    for equation in reversed(jaxpr.eqns):
        if not read & _variables(equation.outvars):
            continue
        read |= _variables(equation.invars)
        name = equation.primitive.name
        counts = [_of_jaxpr(inner) for inner in _inner(equation.params)]
        inner = sum(one.flops for one in counts)
        if name == "dot_general":
            inner = _product(equation)
        elif name == dense.PRODUCT.name:
            inner = _dense(equation)
        elif name == "scan":
            inner *= equation.params["length"]
        elif name == "cond":
            inner = max(one.flops for one in counts)
        elif name == "while":
            at_least |= inner > 0
        flops += inner
        at_least |= any(one.at_least for one in counts)
    return Counted(flops, at_least)


def _variables(operands):
    return {x for x in operands if not isinstance(x, core.Literal)}


def _product(equation):
    (axes, _), _ = equation.params["dimension_numbers"]
    left = equation.invars[0].aval.shape
    inner_size = math.prod(left[axis] for axis in axes)
    return 2.0 * inner_size * math.prod(equation.outvars[0].aval.shape)


def _dense(equation):
    inputs, weight = (x.aval.shape for x in equation.invars)
    return 2.0 * math.prod(inputs) * weight[1]


def _inner(params) -> Iterator[Any]:
    """Yield the programs within an operation of any kind."""
    leaves = jax.tree.leaves(
        list(params.values()),
        is_leaf=lambda x: isinstance(x, (core.Jaxpr, core.ClosedJaxpr)),
    )
    for leaf in leaves:
        if isinstance(leaf, core.ClosedJaxpr):
            yield leaf.jaxpr
        elif isinstance(leaf, core.Jaxpr):
            yield leaf
