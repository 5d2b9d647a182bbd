"""What every hard case is held to, however it came by its numbers."""

import functools

import jax
import numpy as np
import pytest

from experiments.hard_cases import case as hard_case
from experiments.hard_cases.case import ORDERS, Case

# Half the time to compile: for textbook forms, which nobody runs, and for core,
# whose values and slopes `hold` holds as they are run.
ROUGHLY = (("xla_backend_optimization_level", 0),)


def by_case(cases: tuple[Case, ...], slow: tuple[str, ...] = ()):
    """Tests of a room: every case in every precision, and its textbook form.

    Precisions in `slow` run with the slow tests: for cases that take long to compile.
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
    each = [pytest.param(x, id=x.name, marks=pytest.mark.full) for x in cases]

    @pytest.mark.parametrize(("case", "dtype"), runs)
    def test_held(case, dtype):
        hold(case, dtype)

    @pytest.mark.parametrize("case", each)
    def test_the_textbook_form_is_caught(case):
        catches_the_textbook(case)

    return test_held, test_the_textbook_form_is_caught


def in_float32(cases: tuple[Case, ...]):
    """Tests of a room as a whole: its values and slopes together, single inputs."""

    def test_values_and_slopes_are_held():
        hold_slopes(cases)

    @pytest.mark.full
    def test_one_alone_is_held():
        hold_alone(cases)

    return test_values_and_slopes_are_held, test_one_alone_is_held


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
    """Value and derivatives within their bounds."""
    count = len(case.bounds[dtype])
    with jax.enable_x64(dtype == "float64"):
        every = hard_case.evaluate(case.stable, case.inputs, dtype, count)
    for order, result in enumerate(every):
        _within(case, dtype, order, result)


def hold_slopes(cases: tuple[Case, ...]) -> None:
    """Values and slopes of float32 within their bounds, a room in one program."""
    rows = [np.asarray(case.inputs, np.float32) for case in cases]
    counts = [min(2, len(case.bounds["float32"])) for case in cases]
    functions = [
        jax.vmap(hard_case.derivatives(case.stable, count))
        for case, count in zip(cases, counts, strict=True)
    ]
    for case, every in zip(cases, _all(functions, rows, ROUGHLY), strict=True):
        for order, result in enumerate(every):
            _within(case, "float32", order, np.asarray(result))


def hold_alone(cases: tuple[Case, ...]) -> None:
    """Values of single inputs, with and without jit, to the same error as the truth.

    Programs are most of a room's time, so derivatives are not compiled alone: every
    public function has its gradient check that does.
    """
    first = [hard_case.constant(case.inputs[0], "float32") for case in cases]
    jitted = _all([case.stable for case in cases], first)
    for case, x, one in zip(cases, first, jitted, strict=True):
        for how, result in (("jit", one), ("eager", case.stable(x))):
            assert result.dtype == np.float32, f"{case.name}: {how} is {result.dtype}"
            _within(case, "float32", 0, np.asarray(result)[None], slice(1))


def _all(functions, inputs, options=()):
    """Each of its input, compiled together."""

    def every(inputs):
        return [f(x) for f, x in zip(functions, inputs, strict=True)]

    return jax.jit(every, compiler_options=dict(options))(inputs)


def _within(case, dtype, order, result, rows=slice(None)):
    exact = _exact(_Key(case), order, dtype)[rows]
    off = hard_case.errors(case, result, exact, order)
    worst, bound = int(np.argmax(off)), case.bounds[dtype][order]
    assert off[worst] <= bound, (
        f"{case.name}, {dtype}: {ORDERS[order]} off by {off[worst]:.2e} at "
        f"{case.axis} = {case.at[rows][worst]:.17g}, bound {bound:.1e}"
    )


def catches_the_textbook(case: Case) -> None:
    """The bounds would be missed tenfold by the textbook form: the test can fail."""
    highest = {}
    for dtype, name in case.caught:
        highest[dtype] = max(ORDERS.index(name), highest.get(dtype, 0))
    results = {}
    for dtype, order in highest.items():
        with jax.enable_x64(dtype == "float64"):
            results[dtype] = hard_case.evaluate(
                case.textbook, case.inputs, dtype, order + 1, ROUGHLY
            )
    for dtype, name in case.caught:
        order = ORDERS.index(name)
        exact = _exact(_Key(case), order, dtype)
        off = hard_case.errors(case, results[dtype][order], exact, order).max()
        assert off > 10 * case.bounds[dtype][order], (
            f"{case.name}, {dtype}: the textbook {name} is off by {off:.2e} only"
        )
