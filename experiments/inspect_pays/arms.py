"""All that an inspection can advise, as arms of one suite."""

import itertools

from experiments.ablate.arms import Arm, Suite
from nerfies_jax.evidence.findings import (
    BACKGROUND,
    CANNOT_TELL,
    CERTAIN,
    DEPTH,
    LIGHT,
    MOTION,
    START,
    TRANSIENT,
    Finding,
)
from nerfies_jax.runs import adviser, representations
from nerfies_jax.runs.adviser import Advice

DECIDING = (MOTION, LIGHT, TRANSIENT, START, BACKGROUND, DEPTH)


def name_of(advice: Advice) -> str:
    """An arm's: that of a preset alone is the preset's."""
    return "+".join((advice.preset, *advice.overrides))


def advice() -> Suite:
    """Every preset and change that any findings lead to."""
    return Suite(arms=dict(_arms()), claims=(), seeds=1, pictured=(), context="")


def _arms():
    """What is undecided keeps what one of the decisions leads to, but for motion."""
    kinds = representations.installed().values()
    for full, kind in itertools.product((False, True), kinds):
        choices_of = [(True, False)] * len(DECIDING)
        choices_of[DECIDING.index(MOTION)] = (True, False, None)
        for choices in itertools.product(*choices_of):
            decided = zip(DECIDING, choices, strict=True)
            findings = tuple(
                Finding(x, "", "", y, CANNOT_TELL if y is None else CERTAIN)
                for x, y in decided
            )
            advised = adviser.advise(findings, kind, full)
            yield name_of(advised), Arm(advised.preset, advised.overrides)
