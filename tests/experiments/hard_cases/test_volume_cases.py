"""Weights, distances and samples of a ray at their hard points."""

import pytest

from experiments.hard_cases.volume import CASES
from tests.experiments.hard_cases import checks

pytestmark = pytest.mark.hard_cases


def test_values_are_held():
    checks.hold_values(CASES)


@checks.by_case(CASES)
def test_held(case, dtype):
    checks.hold(case, dtype)


@pytest.mark.full
def test_one_alone_is_held():
    checks.hold_alone(CASES)


@checks.each(CASES)
def test_the_textbook_form_is_caught(case):
    checks.catches_the_textbook(case)
