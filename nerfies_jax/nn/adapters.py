"""Modules of flax and equinox as explicit parameters and a pure function.

An adapted module is a `Network` of two functions. Its parameters are a pytree, so that
optax, checkpoints and `jax.tree` work on them.
"""

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

PyTree = Any


class Network(NamedTuple):
    """A network with explicit parameters."""

    init: Callable[[jax.Array], PyTree]  # (key) -> parameters
    apply: Callable[..., Any]  # (parameters, *inputs) -> outputs


def linen(module: Any, *example: Any) -> Network:
    """Adapt a `flax.linen` module.

    Args:
      module: The module, without parameters.
      *example: Example inputs, from whose shapes and types flax makes the parameters.

    Returns:
      The network. Its parameters are the variables that `module.init` makes.

    Raises:
      TypeError: If `module` is not a `flax.linen.Module`.
    """
    module_type = _import_library("flax.linen").Module
    if not isinstance(module, module_type):
        raise TypeError(
            f"adapters.linen: `module` must be a flax.linen.Module, got a "
            f"{type(module).__name__}; use adapters.nnx for modules of flax.nnx"
        )
    return Network(lambda key: module.init(key, *example), module.apply)


def nnx(make: Callable[[Any], Any]) -> Network:
    """Adapt a `flax.nnx` module.

    Args:
      make: A function from `nnx.Rngs` to the module, for example `lambda rngs:
        nnx.Linear(3, 4, rngs=rngs)`.

    Returns:
      The network. Its parameters are the state that `nnx.split` returns. Changes that a
      call makes to the module are lost.
    """
    library = _import_library("flax.nnx")

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
    library = _import_library("equinox")

    def apply(params, *inputs):
        shapes = library.filter_eval_shape(make, jax.random.key(0))
        static = library.filter(shapes, lambda leaf: not hasattr(leaf, "dtype"))
        return library.combine(params, static)(*inputs)

    return Network(lambda key: library.filter(make(key), library.is_array), apply)


def _import_library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ImportError(
            f"adapters need {package}; install it with pip install "
            f"'nerfies-jax[{package}]'"
        ) from error
