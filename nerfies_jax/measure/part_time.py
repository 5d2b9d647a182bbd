"""What one part of a training step takes."""

from collections.abc import Callable
from typing import Any

import jax

from nerfies_jax.measure import clock

REPEATS = 7
PART_SECONDS = 5.0  # for the repeats of one part: a step of a large field takes longer


def part_ms(function: Callable[..., Any], *args: Any) -> float:
    """Median milliseconds of a jitted call, warm.

    Its arrays are inputs, not constants to compile in.
    """
    compiled = jax.jit(function).lower(*args).compile()

    def call():
        return compiled(*args)

    first = clock.measure(call, repeats=1, warm_up=0).median
    repeats = min(REPEATS, int(PART_SECONDS / first))
    if repeats < 2:
        return 1e3 * first
    return 1e3 * clock.measure(call, repeats=repeats, warm_up=0).median
