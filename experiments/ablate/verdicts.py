"""Results of an ablation: the table, and a verdict on every claim."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats

from experiments.ablate import measures
from experiments.ablate.arms import Claim
from experiments.ablate.measures import MEASURES

CONFIDENCE = 0.95  # of the interval that must leave zero out before an effect shows

Numbers = Mapping[tuple[str, int], Mapping[str, float]]  # by arm and seed


class Verdict(NamedTuple):
    """One measure of one claim, with a positive `gain` if the claim is right."""

    claim: Claim
    measure: str
    better: float  # mean over the seeds
    worse: float
    gain: float  # mean over the seeds, each against itself
    half_width: float  # of the gain's confidence interval; NaN with one seed
    says: str


def verdicts(numbers: Numbers, claims: Sequence[Claim]) -> list[Verdict]:
    """Judge every claim whose two methods were run.

    Methods are compared seed by seed, since a seed gives both the same random numbers.
    An effect is significant if Student's interval of the mean difference excludes zero.
    One seed has no spread, and is never significant.

    Args:
      numbers: Measures by method and seed.
      claims: Claims to judge.

    Returns:
      Verdicts.
    """
    judged = []
    for claim in claims:
        seeds = [s for arm, s in numbers if arm == claim.better]
        seeds = [s for s in seeds if (claim.worse, s) in numbers]
        for name in claim.measures if seeds else ():
            pairs = [
                [numbers[arm, seed][name] for arm in (claim.better, claim.worse)]
                for seed in seeds
            ]
            judged.append(_verdict(claim, name, np.asarray(pairs, float)))
    return judged


def _verdict(claim, name, pairs):
    sign = -1 if MEASURES[name].direction == "lower" else 1
    gains = sign * (pairs[:, 0] - pairs[:, 1])
    count, gain = len(gains), float(gains.mean())
    half = math.nan
    if count > 1:
        factor = scipy.stats.t.ppf((1 + CONFIDENCE) / 2, count - 1)
        half = float(factor * gains.std(ddof=1) / math.sqrt(count))
    if not math.isfinite(gain):
        says = "not measured"
    elif count == 1:
        direction = "for" if gain > 0 else "against" if gain < 0 else "neither way"
        says = f"{direction}, but one seed has no spread to hold it against"
    elif abs(gain) <= half:
        says = "no effect beyond the spread over seeds"
    else:
        says = "shows" if gain > 0 else "the opposite shows"
    better, worse = (float(x) for x in pairs.mean(axis=0))
    return Verdict(claim, name, better, worse, gain, half, says)


def table(numbers: Numbers, static: float) -> str:
    """Format means and standard deviations over the seeds, one line per method.

    Costs are in a second table. Columns without numbers are left out.

    Args:
      numbers: Measures by method and seed.
      static: End-point error of a static prediction.

    Returns:
      Text of the table.
    """
    names = measures.shown(numbers)
    quality = [name for name in names if name not in measures.COSTS]
    costs = [name for name in names if name in measures.COSTS]
    lines = _rows(numbers, quality)
    if math.isfinite(static):
        lines.append(f"still: {static:.4f} scene units")
    return "\n".join([*lines, "", *_rows(numbers, costs)])


def _rows(numbers, names):
    cells = [f"{MEASURES[name].heading:>7s}" for name in names]
    lines = [f"{'':16s} " + " ".join(cells)]
    widths = [len(cell) for cell in cells]
    for arm in dict.fromkeys(arm for arm, _ in numbers):
        rows = [row for (name, _), row in numbers.items() if name == arm]
        means, spreads = [], []
        for name, width in zip(names, widths, strict=True):
            values = values_of(rows, name)
            digits = MEASURES[name].digits
            spread = values.std(ddof=1) if len(values) > 1 else math.nan
            mean = _cell(values.mean(), digits, width)
            if name == "track_error" and np.isnan(values).all():
                mean = f"{'still':>{width}s}"
            means.append(mean)
            spreads.append(_cell(spread, digits, width))
        lines.append(f"{arm:16s} " + " ".join(means))
        if len(rows) > 1:
            label = f"  ± of {len(rows)} seeds"
            lines.append(f"{label:16s} " + " ".join(spreads))
    return lines


def values_of(rows: Sequence[Mapping[str, float]], name: str) -> np.ndarray:
    """One measure of all seeds of an arm.

    What compiling takes only those seeds tell that did not find the program made.
    """
    values = np.asarray([row[name] for row in rows], float)
    if name == "compile_seconds" and np.isfinite(values).any():
        return values[np.isfinite(values)]
    return values


def _cell(value, digits, width):
    return f"{value:{width}.{digits}f}" if math.isfinite(value) else f"{'-':>{width}s}"


def claims_text(judged: Sequence[Verdict]) -> str:
    """Every claim, and what each measure says of it."""
    lines, last = [], None
    for verdict in judged:
        if verdict.claim is not last:
            last = verdict.claim
            lines.append(f"{last.statement}: {last.better} against {last.worse}")
        measure = MEASURES[verdict.measure]
        spread = (
            "" if math.isnan(verdict.half_width) else f" ± {verdict.half_width:.3g}"
        )
        unit = f" {measure.unit}" if measure.unit else ""
        lines.append(
            f"    {verdict.measure:20s} {verdict.better:.4g} against "
            f"{verdict.worse:.4g}{unit}, gain {verdict.gain:+.3g}{spread}: "
            f"{verdict.says}"
        )
    tested = sum(math.isfinite(verdict.half_width) for verdict in judged)
    if tested:
        lines.append(
            f"± of a gain: its {CONFIDENCE:.0%} interval (Student, seeds paired). Of "
            f"{tested} such lines, {(1 - CONFIDENCE) * tested:.1f} would show or "
            "oppose by chance."
        )
    return "\n".join(lines)
