"""All that an inspection can advise, as arms of one suite; no JAX."""

import itertools

from experiments import inspect_advice
from experiments.ablate_arms import Arm, Suite
from experiments.inspect_advice import FIELDS, SPLATS, Advice
from experiments.inspect_findings import (
    BACKGROUND,
    CERTAIN,
    DEPTH,
    LIGHT,
    MOTION,
    START,
    TRANSIENT,
    Finding,
)

DECIDING = (MOTION, LIGHT, TRANSIENT, START, BACKGROUND, DEPTH)


def name_of(advice: Advice) -> str:
    """An arm's: that of a preset alone is the preset's."""
    return "+".join((advice.preset, *advice.overrides))


def _arms():
    """What is undecided keeps what one of the decisions leads to: two are enough."""
    for full, kind in itertools.product((False, True), (SPLATS, FIELDS)):
        for choices in itertools.product((True, False), repeat=len(DECIDING)):
            decided = zip(DECIDING, choices, strict=True)
            findings = tuple(Finding(x, "", "", y, CERTAIN) for x, y in decided)
            advice = inspect_advice.advise(findings, kind, full)
            yield name_of(advice), Arm(advice.preset, advice.overrides)


ADVICE = Suite(arms=dict(_arms()), claims=(), seeds=1, pictured=(), context="")
