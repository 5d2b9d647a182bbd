"""Cost of an effect per training step, as measured by `experiments.speed effects`."""

import functools
import importlib.resources
import math
from collections.abc import Mapping

from nerfies_jax.evaluation.representation import Pair
from nerfies_jax.metrics import clock
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.preprocessing.findings import Finding
from nerfies_jax.runs import representations

EFFECT_COST = "effect_cost.json"  # next to this file, written by the study
Price = dict[str, float]  # by representation, NaN if a step takes no longer


@functools.cache
def baseline() -> Mapping[str, Metric]:
    """Read the stored measurements.

    Returns:
      Metrics by key.
    """
    path = importlib.resources.files("nerfies_jax.runs") / EFFECT_COST
    with importlib.resources.as_file(path) as file:
        return clock.read_metrics(file)


def legend() -> str:
    """Explain the column of costs.

    Returns:
      The text.
    """
    names = " / ".join(representations.installed())
    return (
        "cost per step: time of a training step with the effect, divided by that of a "
        f"step without\neffects, for {names} (- if the effect adds nothing). Measured "
        "by experiments.speed effects."
    )


def price(effect: str, metrics: Mapping[str, Metric]) -> Price:
    """Return the cost of an effect as a factor of a step without effects.

    Args:
      effect: Name of the effect.
      metrics: Measured metrics by key.

    Returns:
      Factors by representation, NaN if the effect adds nothing to a step.
    """
    return {
        name: _factor(each.recommendation.prices.get(effect), metrics)
        for name, each in representations.installed().items()
        if each.recommendation is not None
    }


def format_prices(findings: tuple[Finding, ...]) -> dict[str, str]:
    """Format the costs of effects for a table.

    Args:
      findings: Findings, one for each effect.

    Returns:
      Texts by effect.
    """
    return {
        finding.effect: " / ".join(
            f"x{factor:.2f}" if math.isfinite(factor) else "-"
            for factor in price(finding.effect, baseline()).values()
        )
        for finding in findings
    }


def as_json(findings: tuple[Finding, ...]) -> dict[str, dict[str, float | None]]:
    """Return the costs of effects as JSON values.

    Args:
      findings: Findings, one for each effect.

    Returns:
      Factors by effect and representation, None if it adds nothing to a step.
    """
    prices = {finding.effect: price(finding.effect, baseline()) for finding in findings}
    return {
        effect: {k: x if math.isfinite(x) else None for k, x in factors.items()}
        for effect, factors in prices.items()
    }


def _factor(pair: Pair | None, metrics):
    """One plus the time that an effect adds, relative to a step without effects."""
    if pair is None:
        return math.nan
    with_effect, without_effect = (
        metrics[f"{pair.preset}.{variant}.step.over_bare"].value
        for variant in (pair.with_it, pair.without)
    )
    return 1 + with_effect - without_effect
