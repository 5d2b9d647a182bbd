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

EFFECT_COST = "effect_cost.json"  # beside this file; the study writes it
Price = dict[str, float]  # by representation; NaN where an effect costs no step


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
        "cost per step: a training step with the effect over one without any, of "
        f"{names};\n- where no step takes longer. From experiments.speed effects."
    )


def price(effect: str, measured: Mapping[str, Metric]) -> Price:
    """Return the cost of an effect as a factor of a step without effects.

    Args:
      effect: Name of the effect.
      measured: Metrics by key.

    Returns:
      Factors by representation, NaN if the effect adds nothing to a step.
    """
    return {
        name: _factor(each.recommendation.prices.get(effect), measured)
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
        one.effect: " / ".join(
            f"x{factor:.2f}" if math.isfinite(factor) else "-"
            for factor in price(one.effect, baseline()).values()
        )
        for one in findings
    }


def as_json(findings: tuple[Finding, ...]) -> dict[str, dict[str, float | None]]:
    """Return the costs of effects as JSON values.

    Args:
      findings: Findings, one for each effect.

    Returns:
      Factors by effect and representation, None if it adds nothing to a step.
    """
    prices = {one.effect: price(one.effect, baseline()) for one in findings}
    return {
        effect: {k: x if math.isfinite(x) else None for k, x in one.items()}
        for effect, one in prices.items()
    }


def _factor(pair: Pair | None, measured):
    """One plus what the effect adds, in bare steps."""
    if pair is None:
        return math.nan
    dearer, cheaper = (
        measured[f"{pair.preset}.{arm}.step.over_bare"].value
        for arm in (pair.with_it, pair.without)
    )
    return 1 + dearer - cheaper
