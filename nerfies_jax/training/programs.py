"""Programs of a model that take the numbers of its capture as arguments.

A number that is compiled into a program, such as the scale of the scene, is part of its
key in the compilation cache. As an argument it is not, so a second capture of the same
shapes reuses the programs of the first.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.extend import core

from nerfies_jax.training.model import Model, PyTree

Owner = TypeVar("Owner")

# A component from another package converts a number of the capture to a Python or NumPy
# one, or branches on it, which is not possible for a traced number.
_CONCRETE_NUMBERS_NEEDED = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


def taking(owner: Owner, numbers: PyTree, build: Callable[[PyTree], Owner]) -> Owner:
    """Let the programs of a model take the numbers of its capture as arguments.

    Args:
      owner: The model, or the record of a component, with the numbers compiled in. It
        has fields `numbers` and `with_numbers`.
      numbers: The numbers, a pytree of floats and arrays.
      build: Function of numbers, which may be traced, that returns the owner for them.

    Returns:
      The owner with `numbers` and `with_numbers`. Functions of it that the caller
      replaces later stay as they are. If `build` needs concrete numbers, they stay
      compiled into the programs; its other errors are raised.
    """
    original = _fields(owner)

    def replace_numbers(current, numbers):
        try:
            new_fields = _fields(build(numbers))
        except _CONCRETE_NUMBERS_NEEDED:
            return current
        fields = _fields(current)
        same = {
            name: new_fields[name] for name in fields if fields[name] is original[name]
        }
        return type(owner)(**fields | same)

    return type(owner)(
        **original | {"numbers": numbers, "with_numbers": replace_numbers}
    )


def _fields(owner):
    """Return the fields of a named tuple or a dataclass, by name."""
    return owner._asdict() if isinstance(owner, tuple) else vars(owner)


def with_numbers(owner: Any, numbers: PyTree) -> Any:
    """Return a model or field with other numbers of the capture, which may be traced.

    Args:
      owner: A `Model` or a field, with attributes `numbers` and `with_numbers`.
      numbers: Numbers of the structure of its own.

    Returns:
      The model or field, unchanged if its functions take no numbers of the capture.
    """
    return owner if owner.with_numbers is None else owner.with_numbers(owner, numbers)


class Program:
    """A function of a model and of arrays, compiled with `jax.jit`.

    The numbers of the capture are the first argument of the compiled function.

    Args:
      function: Pure function of a model, or field, and arrays. Its name is that of the
        program.
      owner: The model or field.
    """

    def __init__(self, function: Callable[..., Any], owner: Any):
        def program(numbers, *args):
            return function(with_numbers(owner, numbers), *args)

        program.__name__ = function.__name__
        options = getattr(owner, "compiler_options", None)
        self._program = jax.jit(program, compiler_options=options)
        self._owner = owner

    @functools.cached_property
    def _numbers(self):
        # Not computed before a call, because a model that is built while a program is
        # traced has traced numbers.
        return self._owner.numbers

    def __call__(self, *args: Any) -> Any:
        """Call the program for the capture of the model."""
        return self._program(self._numbers, *args)

    def lower(self, *args: Any) -> jax.stages.Lowered:
        """Lower the program. Once compiled, it takes the numbers before `args`."""
        return self._program.lower(self._numbers, *args)


def with_captured(
    function: Callable[..., Any], *args: Any
) -> tuple[Callable[..., Any], list[Any]]:
    """Separate a function from the arrays that it has captured.

    JAX compiles captured arrays into a program, which makes them part of its key in the
    compilation cache.

    Args:
      function: Pure function, whose inner calls of `jax.jit` capture no arrays.
      *args: Example arguments. Only their structure, shapes and dtypes are used.

    Returns:
      A function of the list of captured arrays and of arguments like `args`, and that
      list.
    """
    closed_jaxpr, result = jax.make_jaxpr(function, return_shape=True)(*args)
    structure = jax.tree.structure(result)

    def separate(constants, *args):
        program = core.jaxpr_as_fun(core.ClosedJaxpr(closed_jaxpr.jaxpr, constants))
        return jax.tree.unflatten(structure, program(*jax.tree.leaves(args)))

    constants = [
        x if isinstance(x, jax.Array) else np.asarray(x) for x in closed_jaxpr.consts
    ]
    return separate, constants


def deformer(model: Model) -> Callable[[PyTree], Callable[[Any], PyTree]]:
    """Compile the first two stages of rendering. The renderer has the same programs.

    Args:
      model: A model with stages.

    Returns:
      A function of parameters that returns the second stage as a function of time.
    """
    prepared_of, deformed_of = Program(prepare, model), Program(deform, model)

    def deformer_of(params):
        preparation = prepared_of(params)
        return lambda time: deformed_of(params, preparation, time)

    return deformer_of


def prepare(model: Model, params: PyTree) -> PyTree:
    """Call the first stage of rendering.

    Args:
      model: A model with stages.
      params: Its parameters.

    Returns:
      The cache of the frames, which does not depend on the time.
    """
    assert model.stages is not None
    return model.stages.prepare(params)


def deform(model: Model, params: PyTree, preparation: PyTree, time: Any) -> PyTree:
    """Call the second stage of rendering.

    Args:
      model: A model with stages.
      params: Its parameters.
      preparation: Result of `prepare`.
      time: Time in [0, 1] over the capture.

    Returns:
      The scene at this time.
    """
    assert model.stages is not None
    return model.stages.deform(params, preparation, time)
