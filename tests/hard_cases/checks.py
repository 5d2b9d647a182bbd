"""What every hard case is held to, however it came by its numbers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import hard_case
from experiments.hard_case import ORDERS, Case


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
    # Programs are most of a room's time: value and derivatives share one, and alone
    # slopes are compiled in float32 only, curvatures never.
    whole = _derivatives(case, len(bounds))
    singly = min(len(bounds), 2 if dtype == "float32" else 1)
    alone = jax.jit(_derivatives(case, singly))
    with jax.enable_x64(dtype == "float64"):
        inputs = jnp.asarray(case.inputs, dtype)
        every = jax.jit(jax.vmap(whole))(inputs)
        for order, (together, bound) in enumerate(zip(every, bounds, strict=True)):
            exact = _exact(_Key(case), order, dtype)
            off = hard_case.errors(case, together, exact, order)
            worst = int(np.argmax(off))
            assert off[worst] <= bound, (
                f"{case.name}, {dtype}: {ORDERS[order]} off by {off[worst]:.2e} at "
                f"{case.axis} = {case.at[worst]:.17g}, bound {bound:.1e}"
            )
            size = np.abs(exact).max(axis=tuple(range(1, exact.ndim)))
            allowed = 2 * bound * np.maximum(size, case.floors[order])
            # Alone, and without jit, at the ends and at the worst point.
            some = np.array(sorted({0, worst, len(inputs) - 1}))
            if order < singly:
                one = [alone(inputs[k])[order] for k in some]
                _alike(case, dtype, "jit", one, together[some], allowed[some])
            if order == 0:
                one = [case.stable(inputs[k]) for k in some]
                assert one[0].dtype == together.dtype
                _alike(case, dtype, "eager", one, together[some], allowed[some])


def _derivatives(case, count):
    """One input -> the first so many of value, slope and curvature."""
    forms = [hard_case.derivative(case.stable, order) for order in range(count)]
    return lambda x: tuple(form(x) for form in forms)


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
    for dtype, name in case.caught:
        order = ORDERS.index(name)
        with jax.enable_x64(dtype == "float64"):
            got = hard_case.evaluate(case.textbook, case.inputs, dtype, order)
        exact = _exact(_Key(case), order, dtype)
        off = hard_case.errors(case, got, exact, order).max()
        assert off > 10 * case.bounds[dtype][order], (
            f"{case.name}, {dtype}: the textbook {name} is off by {off:.2e} only"
        )
