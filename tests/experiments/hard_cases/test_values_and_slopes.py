"""Values and gradients of hard cases in float32, one program for a topic."""

import pytest

from experiments.hard_cases.__main__ import TOPICS
from tests.experiments.hard_cases import checks

# These take 9 s each, and the core tests of rotations and splats have more than them.
LONG = ("rotations", "splats")


@pytest.mark.parametrize("topic", [name for name in TOPICS if name not in LONG])
def test_values_and_slopes_are_held(topic):
    cases, _ = TOPICS[topic]
    checks.hold_slopes(cases)
