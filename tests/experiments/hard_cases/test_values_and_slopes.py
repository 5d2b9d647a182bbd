"""Values and gradients of every hard case in float32, one program for a topic."""

import pytest

from experiments.hard_cases.__main__ import TOPICS
from tests.experiments.hard_cases import checks


@pytest.mark.parametrize("topic", TOPICS)
def test_values_and_slopes_are_held(topic):
    cases, _ = TOPICS[topic]
    checks.hold_slopes(cases)
