"""Fourier features and their window at their hard points."""

import pytest

from experiments.hard_cases.encodings import CASES
from tests.experiments.hard_cases import checks

pytestmark = pytest.mark.hard_cases
test_held = checks.by_case(CASES)
