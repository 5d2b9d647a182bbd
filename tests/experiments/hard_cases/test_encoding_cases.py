"""Fourier features and their window at their hard points."""

import pytest

from experiments.hard_cases.encodings import CASES
from tests.experiments.hard_cases import checks


@checks.by_case(CASES)
def test_held(case, dtype):
    checks.hold(case, dtype)


@pytest.mark.hard_cases
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_textbook_form_is_caught(case):
    checks.catches_the_textbook(case)
