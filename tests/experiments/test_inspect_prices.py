"""What an effect costs a step, as the table of an inspection says it."""

import math

import pytest

from experiments.effect_cost import __main__ as effect_cost
from experiments.effect_cost import report as report
from experiments.effect_cost.__main__ import Arm, Priced, Row
from nerfies_jax.evidence import findings as inspect_findings
from nerfies_jax.evidence.findings import (
    BACKGROUND,
    CERTAIN,
    DEPTH,
    LENS,
    LIGHT,
    MASKS,
    MOTION,
    START,
    TEXTURE,
    TRANSIENT,
    Finding,
)
from nerfies_jax.runs import adviser, prices, representations
from nerfies_jax.training import specs

DECIDING = (MOTION, LIGHT, TRANSIENT, START, BACKGROUND, DEPTH)


def measured(**seconds):
    """Metrics as a run of effect_cost writes them; "preset.arm" with _ for spaces."""
    rows = {}
    for key, value in seconds.items():
        preset, arm = key.split("__")
        step = Priced(1.0, 1.0, 1, 1.0, False, 1.0, value, value)
        row = Row(Arm(arm, None, None, None), 1, {"loss": step, "step": step})
        rows.setdefault(preset.replace("_", "-"), []).append(row)
    return {metric.key: metric for metric in report.metrics_of(rows)}


MEASURED = measured(
    nerfies_small__bare=0.1,
    nerfies_small__only_warp=0.15,
    nerfies_small__warp_and_elastic=0.22,
    nerfies_small__warp_and_background=0.16,
    nerf_w_small__bare=0.2,
    nerf_w_small__only_appearance=0.21,
    nerf_w_small__only_transient=0.3,
    splats_deformable_small__bare=0.02,
    splats_deformable_small__only_motion=0.05,
    sonata_small__bare=0.04,
    sonata_small__only_depth=0.042,
)


@pytest.mark.parametrize(
    ("effect", "told"),
    [
        (MOTION, "x2.50 / x2.20"),
        (LIGHT, "- / x1.05"),
        (TRANSIENT, "- / x1.50"),
        (BACKGROUND, "- / x1.10"),  # of a bare step, though it needs the warp
        (DEPTH, "x1.05 / -"),
        (START, "- / -"),
        (LENS, "- / -"),
        (MASKS, "- / -"),
        (TEXTURE, "- / -"),
    ],
)
def test_a_price_is_what_an_effect_adds_in_bare_steps(effect, told):
    assert str(prices.price(effect, MEASURED)) == told


def test_the_kept_baseline_prices_every_decision():
    for pairs in (prices.SPLATS, prices.FIELDS):
        for pair in pairs.values():
            for arm in (pair.with_it, pair.without):
                ratio = prices.baseline()[f"{pair.preset}.{arm}.step.over_bare"]
                assert 0.8 < ratio.value < 20
    motion = prices.price(MOTION, prices.baseline())
    # A network for every Gaussian or sample is never free
    assert min(motion) > 1.2


def test_what_a_decision_switches_on_has_a_price():
    """An effect that changes the compiled step is priced, whatever it is called."""
    kinds = {"splats": prices.SPLATS, "fields": prices.FIELDS}
    for kind, pairs in kinds.items():
        for effect in DECIDING:
            scenes = [_effects(kind, effect, wanted) for wanted in (True, False)]
            changed = scenes[0] != scenes[1]
            assert changed == (effect in pairs), (kind, effect)


def _effects(kind, effect, wanted):
    """Names of the effects in the scene that is advised, the other decisions alike."""
    choices = {MOTION: True, LIGHT: False, TRANSIENT: False, BACKGROUND: True}
    choices[MOTION] = effect != TRANSIENT  # which is not advised beside a warp
    choices[effect] = wanted
    findings = tuple(Finding(x, "", "", y, CERTAIN) for x, y in choices.items())
    advice = adviser.advise(findings, kind)
    presets = representations.of_preset(advice.preset).presets
    spec = specs.override(presets[advice.preset], advice.overrides)
    return effect_cost.effects_in(spec)


def test_the_table_and_the_json_have_the_price():
    findings = (
        Finding(MOTION, "it moves", "0.5 %", True, CERTAIN),
        Finding(START, "points", "300", True, CERTAIN),
    )
    costs = {MOTION: "x2.50 / x2.20", START: "- / -"}
    head, _, motion, start, *_ = inspect_findings.table(findings, costs)
    column = head.index("cost per step")
    assert motion[column:].startswith("x2.50 / x2.20  it moves")
    assert start[column:].startswith("- / -")
    assert prices.told(findings)[START] == "- / -"
    stored = prices.as_json(findings)
    assert stored[START] == {"splats": None, "fields": None}
    assert all(math.isfinite(factor) for factor in stored[MOTION].values())
