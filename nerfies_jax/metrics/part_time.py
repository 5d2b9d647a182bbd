"""Times of the parts of a training step."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from typing import Any, NamedTuple

import jax

from nerfies_jax.metrics import clock
from nerfies_jax.runtime import compiler

REPEATS = 7
PART_SECONDS = 5.0  # for repeated calls of one part. Steps of large fields take longer.


class Part(NamedTuple):
    """One part of a step, ready to be timed."""

    compiled: Future[jax.stages.Compiled]
    args: tuple[Any, ...]


class StepParts(NamedTuple):
    """The parts of one step, compiled in the background."""

    parts: dict[str, Part]
    # From the milliseconds of the parts to the same with the remainder of a step, whose
    # total time it measures.
    with_rest: Callable[[dict[str, float]], dict[str, float]]

    def ms(self) -> dict[str, float]:
        """Measure all parts.

        Returns:
          Milliseconds of each part and of the remainder of the step, by name.
        """
        return self.with_rest(parts_ms(self.parts))

    def drop(self) -> None:
        """Cancel pending compilations."""
        for one in self.parts.values():
            one.compiled.cancel()


def part(function: Callable[..., Any], *args: Any) -> Part:
    """Compile a call in the background. Its arrays are inputs, not constants.

    Args:
      function: The function.
      *args: Its arguments.

    Returns:
      The part.
    """
    return Part(compiler.begun(jax.jit(function).lower(*args).compile), args)


def parts_ms(parts: Mapping[str, Part]) -> dict[str, float]:
    """Measure calls after all of them have been compiled.

    Args:
      parts: Parts by name.

    Returns:
      Median milliseconds of a call, by name.
    """
    wait(one.compiled for one in parts.values())
    return {name: _median_ms(one) for name, one in parts.items()}


def _median_ms(one):
    program = one.compiled.result()

    def call():
        return program(*one.args)

    first = clock.measure(call, repeats=1, warm_up=0).median
    repeats = min(REPEATS, int(PART_SECONDS / first))
    if repeats < 2:
        return 1e3 * first
    return 1e3 * clock.measure(call, repeats=repeats, warm_up=0).median
