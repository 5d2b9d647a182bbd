"""Motions by rows at their hard points."""

import pytest

from experiments.hard_cases import motions as hard_motions
from tests.experiments.hard_cases import checks

CASES = hard_motions.CASES

pytestmark = pytest.mark.hard_cases
test_held = checks.by_case(CASES)
