"""Statistics over seeds, and verdicts on the claims of a suite."""

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import scipy.stats

from experiments.benchmark.suites import Claim
from nerfies_jax.metrics.metric_table import METRICS
from nerfies_jax.runs.curves import Curve

CONFIDENCE = 0.95  # of the interval of a gain


class Verdict(NamedTuple):
    """Verdict on a claim by one metric. A positive gain supports the claim."""

    claim: str
    better: str
    worse: str
    metric: str
    gain: float  # mean difference of the two methods, seed by seed
    half_width: float | None  # of its confidence interval; None with one seed
    verdict: str


def summary(seeds: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Summarize the metrics of the runs of one method.

    Args:
      seeds: Metrics of each run.

    Returns:
      Number of seeds, mean and standard deviation of each metric, as JSON values.
    """
    values: dict[str, list[float]] = {}
    for metrics in seeds:
        for key, value in metrics.items():
            if math.isfinite(value):
                values.setdefault(key, []).append(value)
    return {
        "seeds": len(seeds),
        "mean": {key: statistics.fmean(each) for key, each in values.items()},
        "spread": {
            key: statistics.stdev(each) for key, each in values.items() if len(each) > 1
        },
    }


def curve(run_curve: Curve) -> dict[str, Any]:
    """Select what is stored of the curve of a run.

    Args:
      run_curve: The curve.

    Returns:
      Number of evaluated frames, and lists of steps, processor seconds and scores, as
      JSON values.
    """
    lists = {
        "steps": run_curve.steps,
        "cpu_seconds": [_round(value, 2) for value in run_curve.cpu_seconds],
        "psnr": [_round(value, 3) for value in run_curve.psnr],
        "ssim": [_round(value, 4) for value in run_curve.ssim],
    }
    values = {name: list(each) for name, each in lists.items()}
    return {"frames": len(run_curve.frames), **values}


def _round(value, digits):
    return round(value, digits) if math.isfinite(value) else None


def judge(
    numbers: Mapping[tuple[str, int], Mapping[str, float]], claims: Iterable[Claim]
) -> list[Verdict]:
    """Judge every claim whose two methods were run, by each metric that both have.

    Methods are compared seed by seed, since a seed gives both the same random numbers.
    A gain is significant if Student's interval of the mean difference excludes zero.

    Args:
      numbers: Metrics by method and seed.
      claims: Claims to judge.

    Returns:
      Verdicts.
    """
    verdicts = []
    for claim in claims:
        seeds = [s for method, s in numbers if method == claim.better]
        seeds = [seed for seed in seeds if (claim.worse, seed) in numbers]
        for metric in claim.metrics:
            pairs = [
                (numbers[claim.better, seed], numbers[claim.worse, seed])
                for seed in seeds
            ]
            gains = [_gain(metric, *pair) for pair in pairs]
            if gains and all(map(math.isfinite, gains)):
                verdicts.append(_verdict(claim, metric, gains))
    return verdicts


def _gain(metric, better, worse):
    sign = -1 if METRICS[metric].direction == "lower" else 1
    return sign * (better.get(metric, math.nan) - worse.get(metric, math.nan))


def _verdict(claim, metric, gains):
    gain, half_width = statistics.fmean(gains), None
    if len(gains) == 1:
        text = "one seed, not significant"
    else:
        factor = float(scipy.stats.t.ppf((1 + CONFIDENCE) / 2, len(gains) - 1))
        half_width = factor * statistics.stdev(gains) / math.sqrt(len(gains))
        text = "supported" if gain > 0 else "contradicted"
        text = text if abs(gain) > half_width else "not significant"
    statement, better, worse, _ = claim
    return Verdict(statement, better, worse, metric, gain, half_width, text)


def merge(
    earlier: Mapping[str, dict[str, Any]], later: Mapping[str, dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Replace benchmarks, and methods and claims of benchmarks, by later ones.

    Args:
      earlier: Stored benchmarks by their label.
      later: New benchmarks, of all or some of the methods.

    Returns:
      All benchmarks. Each method has the revision that measured it.
    """
    benchmarks = dict(earlier)
    for label, new in later.items():
        old = benchmarks.get(label, {"methods": {}, "claims": []})
        methods = {
            name: {"revision": old["revision"]} | entry
            for name, entry in old["methods"].items()
        }
        # Others compared a method that was measured again.
        claims = [
            entry
            for entry in old["claims"]
            if not {entry["better"], entry["worse"]} & set(new["methods"])
        ]
        benchmarks[label] = new | {
            "methods": methods | new["methods"],
            "claims": [*claims, *new["claims"]],
        }
    return benchmarks
