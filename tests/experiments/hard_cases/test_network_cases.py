"""Networks and optimizers at their hard points."""

import pytest

from experiments.hard_cases.networks import CASES
from tests.experiments.hard_cases import checks

pytestmark = pytest.mark.hard_cases
test_values_and_slopes_are_held, test_one_alone_is_held = checks.in_float32(CASES)
test_held, test_the_textbook_form_is_caught = checks.by_case(CASES)
