"""Weights, distances and samples of a ray at their hard points."""

import pytest

from experiments.hard_cases.volume import CASES
from tests.experiments.hard_cases import checks

pytestmark = pytest.mark.hard_cases
test_held = checks.by_case(CASES)
