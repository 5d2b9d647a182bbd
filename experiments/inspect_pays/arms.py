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


def held_against() -> tuple[str, ...]:
    """The presets in whose place advice takes whatever the findings lead to.

    Any other stays, with effects switched in it.
    """
    return tuple(
        preset
        for kind in representations.installed().values()
        for preset in kind.presets
        if adviser.advise_for((), preset)
        == adviser.advise((), kind, not preset.endswith("-small"))
    )


def advice() -> Suite:
    """Every preset and change that any findings lead to, and what they are held
    against."""
    arms = {preset: Arm(preset) for preset in held_against()} | dict(_arms())
    return Suite(arms=arms, claims=(), seeds=1, pictured=(), context="")


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
