"""Modules of flax and equinox as explicit parameters and a pure function.

An adapted module is a `Network` of two functions, so its parameters are a pytree like
all others here: optax, checkpoints and `jax.tree` work on them.
"""

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

PyTree = Any


class Network(NamedTuple):
    """A network with explicit parameters."""

    init: Callable[[jax.Array], PyTree]  # of a key: the parameters
    apply: Callable[..., Any]  # of the parameters and inputs: the outputs


def linen(module: Any, *example: Any) -> Network:
    """Adapt a `flax.linen` module.

    Args:
      module: The module, without parameters.
      *example: Inputs of the shapes and types that it will get, which flax needs to
        make the parameters.

    Returns:
      The network. Its parameters are the variables that `module.init` makes.

    Raises:
      TypeError: Where `module` is no `flax.linen.Module`.
    """
    kind = _library("flax.linen").Module
    if not isinstance(module, kind):
        raise TypeError(
            f"adapters.linen: `module` must be a flax.linen.Module, got a "
            f"{type(module).__name__}; modules of flax.nnx go to adapters.nnx"
        )
    return Network(lambda key: module.init(key, *example), module.apply)


def nnx(make: Callable[[Any], Any]) -> Network:
    """Adapt a `flax.nnx` module.

    Args:
      make: A function from `nnx.Rngs` to the module, for example `lambda rngs:
        nnx.Linear(3, 4, rngs=rngs)`.

    Returns:
      The network. Its parameters are the state that `nnx.split` gives. Changes that a
      call makes in the module are not kept.
    """
    library = _library("flax.nnx")

    def split(key):
        return library.split(make(library.Rngs(key)))

    def apply(params, *inputs):
        graph = library.split(library.eval_shape(lambda: make(library.Rngs(0))))[0]
        return library.merge(graph, params)(*inputs)

    return Network(lambda key: split(key)[1], apply)


def equinox(make: Callable[[jax.Array], Any]) -> Network:
    """Adapt an `equinox` module.

    Args:
      make: A function from a key to the module, for example
        `lambda key: eqx.nn.MLP(3, 4, 16, 2, key=key)`.

    Returns:
      The network. Its parameters are the module's arrays, in a module whose other
      fields are None. As in equinox, it takes one item; map it with `jax.vmap`.
    """
    library = _library("equinox")

    def apply(params, *inputs):
        shapes = library.filter_eval_shape(make, jax.random.key(0))
        rest = library.filter(shapes, lambda leaf: not hasattr(leaf, "dtype"))
        return library.combine(params, rest)(*inputs)

    return Network(lambda key: library.filter(make(key), library.is_array), apply)


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ImportError(
            f"adapters need {package}; install it with pip install "
            f"'nerfies-jax[{package}]'"
        ) from error
