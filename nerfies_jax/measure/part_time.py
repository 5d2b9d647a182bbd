"""What the parts of a training step take."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from typing import Any, NamedTuple

import jax

from nerfies_jax import compiler
from nerfies_jax.measure import clock

REPEATS = 7
PART_SECONDS = 5.0  # for the repeats of one part: a step of a large field takes longer


class Part(NamedTuple):
    """One part of a step, ready to be timed."""

    compiled: Future[jax.stages.Compiled]
    args: tuple[Any, ...]


class StepParts(NamedTuple):
    """The parts of one step, compiled in the background."""

    parts: dict[str, Part]
    # Of their milliseconds; times the whole step, and says what they leave of it.
    with_rest: Callable[[dict[str, float]], dict[str, float]]

    def ms(self) -> dict[str, float]:
        """Milliseconds of each part and of what they leave of the step, by name."""
        return self.with_rest(parts_ms(self.parts))

    def drop(self) -> None:
        """What is not compiled yet will not be."""
        for one in self.parts.values():
            one.compiled.cancel()


def part(function: Callable[..., Any], *args: Any) -> Part:
    """A call, compiled in the background; its arrays are inputs, not constants."""
    return Part(compiler.begun(jax.jit(function).lower(*args).compile), args)


def parts_ms(parts: Mapping[str, Part]) -> dict[str, float]:
    """Median milliseconds of each call, warm, once all of them are compiled."""
    wait(one.compiled for one in parts.values())
    return {name: _median_ms(one) for name, one in parts.items()}


def _median_ms(one):
    compiled = one.compiled.result()

    def call():
        return compiled(*one.args)

    first = clock.measure(call, repeats=1, warm_up=0).median
    repeats = min(REPEATS, int(PART_SECONDS / first))
    if repeats < 2:
        return 1e3 * first
    return 1e3 * clock.measure(call, repeats=repeats, warm_up=0).median
