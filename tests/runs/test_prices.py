"""What an effect costs a step, as the table of an inspection says it."""

import dataclasses
import math

import pytest

from nerfies_jax.metrics.clock import Metric
from nerfies_jax.preprocessing import findings as all_findings
from nerfies_jax.preprocessing.findings import (
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


def measured(ratios):
    """Metrics as a run of the study keeps them, from steps over a bare one."""
    keys = {f"{scene}.step.over_bare": value for scene, value in ratios.items()}
    return {key: Metric(key, value, "", "lower") for key, value in keys.items()}


MEASURED = measured(
    {
        "nerfies-small.bare": 1.0,
        "nerfies-small.only_warp": 1.5,
        "nerfies-small.warp_and_elastic": 2.2,
        "nerfies-small.warp_and_background": 1.6,
        "nerf-w-small.bare": 1.0,
        "nerf-w-small.only_appearance": 1.05,
        "nerf-w-small.only_transient": 1.5,
        "splats-static-small.bare": 1.0,
        "splats-static-small.only_exposure": 1.02,
        "splats-deformable-small.bare": 1.0,
        "splats-deformable-small.only_motion": 2.5,
        "sonata-small.bare": 1.0,
        "sonata-small.only_depth": 1.05,
    }
)
NONE = math.nan  # no step takes longer


@pytest.mark.parametrize(
    ("effect", "gaussians", "radiance"),
    [
        (MOTION, 2.5, 2.2),
        (LIGHT, 1.02, 1.05),
        (TRANSIENT, NONE, 1.5),
        (BACKGROUND, NONE, 1.1),  # of a bare step, though it needs the warp
        (DEPTH, 1.05, NONE),
        (START, NONE, NONE),
        (LENS, NONE, NONE),
        (MASKS, NONE, NONE),
        (TEXTURE, NONE, NONE),
    ],
)
def test_a_price_is_what_an_effect_adds_in_bare_steps(effect, gaussians, radiance):
    price = prices.price(effect, MEASURED)
    expected = {"gaussians": gaussians, "radiance": radiance}
    assert price == pytest.approx(expected, nan_ok=True)


def test_the_kept_baseline_prices_every_decision():
    for kind in representations.installed().values():
        for pair in kind.recommendation.prices.values():
            for arm in (pair.with_it, pair.without):
                ratio = prices.baseline()[f"{pair.preset}.{arm}.step.over_bare"]
                assert 0.8 < ratio.value < 20
    motion = prices.price(MOTION, prices.baseline())
    # A network for every Gaussian or sample is never free
    assert min(motion.values()) > 1.2


@pytest.mark.parametrize("name", representations.installed())
@pytest.mark.parametrize("effect", DECIDING)
def test_what_a_decision_switches_on_has_a_price(name, effect):
    """An effect that changes the compiled step is priced, whatever it is called."""
    kind = representations.named(name)
    switched_on, left_out = (_effects(kind, effect, wanted) for wanted in (True, False))
    assert (switched_on != left_out) == (effect in kind.recommendation.prices)


def _effects(kind, effect, wanted):
    """Names of the effects in the scene that is advised, the other decisions alike."""
    choices = {MOTION: True, LIGHT: False, TRANSIENT: False, BACKGROUND: True}
    # A transient medium is not advised next to a warp, nor a depth loss next to tracks.
    choices[MOTION] = effect not in (TRANSIENT, DEPTH)
    choices[effect] = wanted
    findings = tuple(Finding(x, "", "", y, CERTAIN) for x, y in choices.items())
    family = "nerfies" if kind.name == "radiance" else None  # grids need no background
    advice = adviser.advise(findings, kind, family=family)
    spec = specs.override(kind.presets[advice.preset], advice.overrides)
    return [
        field.name
        for field in dataclasses.fields(spec)
        if field.default is None and dataclasses.is_dataclass(getattr(spec, field.name))
    ]


def test_the_table_and_the_json_have_the_price():
    findings = (
        Finding(MOTION, "it moves", "0.5 %", True, CERTAIN),
        Finding(START, "points", "300", True, CERTAIN),
    )
    costs = {MOTION: "x2.50 / x2.20", START: "- / -"}
    head, _, motion, start, *_ = all_findings.table(findings, costs)
    column = head.index("cost per step")
    assert motion[column:].startswith("x2.50 / x2.20  it moves")
    assert start[column:].startswith("- / -")
    assert prices.format_prices(findings)[START] == "- / -"
    stored = prices.as_json(findings)
    assert stored[START] == {"gaussians": None, "radiance": None}
    assert all(math.isfinite(factor) for factor in stored[MOTION].values())
