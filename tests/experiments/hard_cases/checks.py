"""Checks that every hard case passes."""

import functools

import jax
import numpy as np
import pytest

from experiments.hard_cases import case as hard_case
from experiments.hard_cases.case import ORDERS, Case

# Half the time to compile for core: `hold` holds both as users compile them.
ROUGHLY = (("xla_backend_optimization_level", 0),)


def by_case(cases: tuple[Case, ...], slow: tuple[str, ...] = ()):
    """Make the test of a topic that holds every case in every precision.

    Precisions in `slow` run with the slow tests, for cases that take long to compile.
    """
    runs = [
        pytest.param(
            case,
            dtype,
            id=f"{case.name}-{dtype}",
            marks=pytest.mark.slow if dtype in slow else pytest.mark.full,
        )
        for case in cases
        for dtype in case.bounds
    ]

    @pytest.mark.parametrize(("case", "dtype"), runs)
    def test_held(case, dtype):
        hold(case, dtype)

    return test_held


@functools.cache
def _exact(case_key, order, dtype):
    case = case_key.case
    return hard_case.truth(case, hard_case.round_to(case.inputs, dtype), order)


class _Key:
    """A case by its identity: its arrays cannot be hashed."""

    def __init__(self, case):
        self.case = case

    def __hash__(self):
        return id(self.case)

    def __eq__(self, other):
        return self.case is other.case


def hold(case: Case, dtype: str) -> None:
    """Check that value and derivatives are within their bounds."""
    count = len(case.bounds[dtype])
    with jax.enable_x64(dtype == "float64"):
        every = hard_case.evaluate(case.stable, case.inputs, dtype, count)
    for order, result in enumerate(every):
        _within(case, dtype, order, result)


def hold_slopes(cases: tuple[Case, ...]) -> None:
    """Hold values and gradients of float32 within their bounds, in one program."""
    rows = [np.asarray(case.inputs, np.float32) for case in cases]
    counts = [min(2, len(case.bounds["float32"])) for case in cases]
    functions = [
        jax.vmap(hard_case.derivatives(case.stable, count))
        for case, count in zip(cases, counts, strict=True)
    ]

    def every(inputs):
        return [f(x) for f, x in zip(functions, inputs, strict=True)]

    results = jax.jit(every, compiler_options=dict(ROUGHLY))(rows)
    for case, orders in zip(cases, results, strict=True):
        for order, result in enumerate(orders):
            _within(case, "float32", order, np.asarray(result))


def _within(case, dtype, order, result):
    exact = _exact(_Key(case), order, dtype)
    off = hard_case.errors(case, result, exact, order)
    worst, bound = int(np.argmax(off)), case.bounds[dtype][order]
    assert off[worst] <= bound, (
        f"{case.name}, {dtype}: {ORDERS[order]} off by {off[worst]:.2e} at "
        f"{case.axis} = {case.at[worst]:.17g}, bound {bound:.1e}"
    )
