"""What an effect adds to a step, read from a kept run of `experiments.effect_cost`."""

import functools
import importlib.resources
import math
from collections.abc import Mapping
from typing import NamedTuple

from experiments.inspect_findings import (
    BACKGROUND,
    DEPTH,
    LIGHT,
    MOTION,
    TRANSIENT,
    Finding,
)
from nerfies_jax.measure import clock
from nerfies_jax.measure.clock import Metric

LEGEND = (
    "cost per step: a training step with the effect over one without any, of splats / "
    "of a field;\n- where no step takes longer. From experiments.effect_cost."
)


class Pair(NamedTuple):
    """Two scenes of a preset that differ in what a decision switches on."""

    preset: str
    with_it: str  # as in the keys of effect_cost.json
    without: str = "bare"


# What `inspect_advice` builds; motion brings the elastic penalty along in fields.
SPLATS = {
    MOTION: Pair("splats-deformable-small", "only_motion"),
    DEPTH: Pair("sonata-small", "only_depth"),
}
FIELDS = {
    MOTION: Pair("nerfies-small", "warp_and_elastic"),
    LIGHT: Pair("nerf-w-small", "only_appearance"),
    TRANSIENT: Pair("nerf-w-small", "only_transient"),
    BACKGROUND: Pair("nerfies-small", "warp_and_background", "only_warp"),
}


class Price(NamedTuple):
    """A step with the effect, over a bare step; NaN where it costs no step anything."""

    splats: float
    fields: float

    def __str__(self):
        return " / ".join(
            f"x{factor:.2f}" if math.isfinite(factor) else "-" for factor in self
        )


@functools.cache
def baseline() -> Mapping[str, Metric]:
    """The committed numbers, by key."""
    folder = importlib.resources.files("experiments") / "measured"
    with importlib.resources.as_file(folder / "effect_cost.json") as path:
        return clock.read_metrics(path)


def price(effect: str, measured: Mapping[str, Metric]) -> Price:
    """Of a finding's effect; the factor is one plus what it adds, in bare steps."""
    return Price(*(_factor(pairs.get(effect), measured) for pairs in (SPLATS, FIELDS)))


def told(findings: tuple[Finding, ...]) -> dict[str, str]:
    """By effect, what it costs a step, for a table."""
    return {one.effect: str(price(one.effect, baseline())) for one in findings}


def as_json(findings: tuple[Finding, ...]) -> dict[str, dict[str, float | None]]:
    """By effect, its factors; None where it costs nothing in a step."""
    prices = {one.effect: price(one.effect, baseline()) for one in findings}
    return {
        effect: {k: x if math.isfinite(x) else None for k, x in one._asdict().items()}
        for effect, one in prices.items()
    }


def _factor(pair, measured):
    if pair is None:
        return math.nan
    dearer, cheaper = (
        measured[f"{pair.preset}.{arm}.step.over_bare"].value
        for arm in (pair.with_it, pair.without)
    )
    return 1 + dearer - cheaper
