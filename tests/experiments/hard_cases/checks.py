"""What every hard case is held to, however it came by its numbers."""

import functools

import jax
import numpy as np
import pytest

from experiments.hard_cases import case as hard_case
from experiments.hard_cases.case import ORDERS, Case

# Half the time to compile, for what nobody runs and is wrong anyway.
ROUGHLY = (("xla_backend_optimization_level", 0),)


def by_case(cases: tuple[Case, ...], slow: tuple[str, ...] = ()):
    """The marks of a test that runs for every case in every precision.

    Precisions in `slow` run with the slow tests: for cases that take long to compile.
    """
    runs = [
        pytest.param(
            case,
            dtype,
            id=f"{case.name}-{dtype}",
            marks=pytest.mark.slow if dtype in slow else (),
        )
        for case in cases
        for dtype in case.bounds
    ]

    def mark(test):
        return pytest.mark.hard_cases(
            pytest.mark.parametrize(("case", "dtype"), runs)(test)
        )

    return mark


@functools.cache
def _exact(case_key, order, dtype):
    case = case_key.case
    return hard_case.truth(case, hard_case.rounded(case.inputs, dtype), order)


class _Key:
    """A case by its identity: its arrays cannot be hashed."""

    def __init__(self, case):
        self.case = case

    def __hash__(self):
        return id(self.case)

    def __eq__(self, other):
        return self.case is other.case


def hold(case: Case, dtype: str) -> None:
    """Value and derivatives within their bounds, eager, under jit and under vmap."""
    bounds = case.bounds[dtype]
    with jax.enable_x64(dtype == "float64"):
        every = hard_case.evaluate(case.stable, case.inputs, dtype, len(bounds))
        for order, (together, bound) in enumerate(zip(every, bounds, strict=True)):
            exact = _exact(_Key(case), order, dtype)
            off = hard_case.errors(case, together, exact, order)
            worst = int(np.argmax(off))
            assert off[worst] <= bound, (
                f"{case.name}, {dtype}: {ORDERS[order]} off by {off[worst]:.2e} at "
                f"{case.axis} = {case.at[worst]:.17g}, bound {bound:.1e}"
            )
            if order == 0:
                # Alone, and without jit, at the ends and at the worst point.
                some = np.array(sorted({0, worst, len(off) - 1}))
                size = np.maximum(np.abs(exact).max(axis=1), case.floors[0])
                _alone(case, dtype, some, together[some], 2 * bound * size[some])


def _alone(case, dtype, some, together, bounds):
    """Values of single inputs, with and without jit, as of all at once.

    Programs are most of a room's time, so derivatives are not compiled alone: every
    public function has its gradient check that does.
    """
    inputs = [hard_case.constant(row, dtype) for row in case.inputs[some]]
    for how, function in (("jit", jax.jit(case.stable)), ("eager", case.stable)):
        found = [function(x) for x in inputs]
        assert found[0].dtype == together.dtype
        _alike(case, dtype, how, found, together, bounds)


def _alike(case, dtype, how, alone, together, bounds):
    """One by one as all at once, to the same error as the truth."""
    alone = np.stack([np.asarray(x, np.float64) for x in alone])
    off = np.abs(alone - np.asarray(together, np.float64))
    off = off.reshape(len(off), -1).max(axis=1)
    assert np.all(off <= bounds + np.finfo(np.float64).tiny), (
        f"{case.name}, {dtype}: {how} differs from vmap by {np.max(off):.2e}"
    )


def catches_the_textbook(case: Case) -> None:
    """The bounds would be missed tenfold by the textbook form: the test can fail."""
    highest = {}
    for dtype, name in case.caught:
        highest[dtype] = max(ORDERS.index(name), highest.get(dtype, 0))
    found = {}
    for dtype, order in highest.items():
        with jax.enable_x64(dtype == "float64"):
            found[dtype] = hard_case.evaluate(
                case.textbook, case.inputs, dtype, order + 1, ROUGHLY
            )
    for dtype, name in case.caught:
        order = ORDERS.index(name)
        exact = _exact(_Key(case), order, dtype)
        off = hard_case.errors(case, found[dtype][order], exact, order).max()
        assert off > 10 * case.bounds[dtype][order], (
            f"{case.name}, {dtype}: the textbook {name} is off by {off:.2e} only"
        )
