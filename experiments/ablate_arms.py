"""What the ablation compares, what it measures, and what is claimed; no JAX."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats

CONFIDENCE = 0.95  # of the interval that must leave zero out before an effect shows


@dataclasses.dataclass(frozen=True)
class Arm:
    """One way to reconstruct: a preset, and what is changed in it, as for `--set`."""

    preset: str
    changes: tuple[str, ...] = ()


ARMS = {
    "static": Arm("nerf-small"),
    "t-nerf": Arm("t-nerf-small"),
    "d-nerf": Arm("d-nerf-small"),
    "nerfies": Arm("nerfies-small"),
    "no-elastic": Arm("nerfies-small", ("elastic=none",)),
    "no-background": Arm("nerfies-small", ("background=none",)),
    "coarse-to-fine": Arm("nerfies-small", ("warp.anneal_steps=300",)),
    "translation": Arm("nerfies-small", ("warp.kind=translation",)),
}


class Measure(NamedTuple):
    """One number of a trained arm."""

    heading: str  # in the table
    unit: str
    direction: str  # which is better: "lower" or "higher"
    tolerance: float  # how much worse a later run may be, in the unit
    digits: int  # behind the point


MEASURES = {
    "psnr": Measure("PSNR", "dB", "higher", 0.5, 2),
    "ssim": Measure("SSIM", "", "higher", 0.02, 3),
    "moving_psnr": Measure("moving", "dB", "higher", 0.5, 2),
    "moving_ssim": Measure("SSIM", "", "higher", 0.03, 3),
    "depth_median": Measure("depth", "scene units", "lower", 0.002, 4),
    "depth_rmse": Measure("RMSE", "scene units", "lower", 0.01, 4),
    "moving_depth_median": Measure("moving", "scene units", "lower", 0.005, 4),
    "moving_depth_rmse": Measure("RMSE", "scene units", "lower", 0.02, 4),
    "track_error": Measure("EPE", "scene units", "lower", 0.003, 4),
    "track_correct": Measure("<0.01", "", "higher", 0.05, 2),
    "track_lost": Measure("lost", "", "lower", 0.02, 3),
    "drift": Measure("drift", "scene units", "lower", 0.002, 4),
    "strain": Measure("strain", "", "lower", 0.1, 2),
    "train_seconds": Measure("train s", "s", "lower", 60.0, 0),
    "train_cpu_seconds": Measure("CPU s", "s", "lower", 60.0, 0),
    "compile_seconds": Measure("compile", "s", "lower", 10.0, 1),
    "render_ms": Measure("frame ms", "ms", "lower", 500.0, 0),
}
LEGEND = """\
psnr, ssim: held-out camera; "moving" over the pixels that show moving things.
depth: median and root mean square of the error, scene units; then of moving pixels.
EPE: mean distance of points followed from the middle instant to where they really are;
<0.01: share nearer than that; lost: share that was not found and counts as not moved.
still: the EPE of a point that does not move, all that a field without a warp can say.
drift: how far static points wander in the template; strain: ||log S|| of the warp's
Jacobian (root mean square)."""


class Claim(NamedTuple):
    """That one arm is better than another, by some measures."""

    statement: str
    better: str
    worse: str
    measures: tuple[str, ...]


CLAIMS = (
    Claim(
        "A static field cannot show what deforms; a warped one can",
        "nerfies",
        "static",
        ("moving_psnr", "moving_ssim", "moving_depth_median"),
    ),
    Claim(
        "A template under a warp beats a field that reads the time (no claim of the "
        "lecture: the honest baseline)",
        "nerfies",
        "t-nerf",
        ("moving_psnr", "moving_ssim", "moving_depth_median"),
    ),
    Claim(
        "SE(3) beats a field of translations",
        "nerfies",
        "translation",
        ("track_error", "moving_psnr", "strain"),
    ),
    Claim(
        "Elastic regularisation finds the more rigid and better solution",
        "nerfies",
        "no-elastic",
        ("track_error", "moving_psnr", "strain"),
    ),
    Claim(
        "Background regularisation keeps the background still",
        "nerfies",
        "no-background",
        ("drift", "track_error", "moving_psnr"),
    ),
    Claim(
        "Coarse-to-fine avoids poor local minima",
        "coarse-to-fine",
        "nerfies",
        ("track_error", "moving_psnr"),
    ),
)

Numbers = Mapping[tuple[str, int], Mapping[str, float]]  # by arm and seed


class Verdict(NamedTuple):
    """One measure of one claim; `gain` is positive where the claim is right."""

    claim: Claim
    measure: str
    better: float  # mean over the seeds
    worse: float
    gain: float  # mean over the seeds, each against itself
    half_width: float  # of the gain's confidence interval; NaN with one seed
    says: str


def verdicts(numbers: Numbers, claims: Sequence[Claim] = CLAIMS) -> list[Verdict]:
    """What the numbers say of every claim whose two arms were run.

    Arms are compared seed by seed, which draws the same rays for both. An effect shows
    where Student's interval of the mean difference leaves zero out; one seed has no
    spread, and so cannot show any.
    """
    found = []
    for claim in claims:
        seeds = [s for arm, s in numbers if arm == claim.better]
        seeds = [s for s in seeds if (claim.worse, s) in numbers]
        for name in claim.measures if seeds else ():
            pairs = [
                [numbers[arm, seed][name] for arm in (claim.better, claim.worse)]
                for seed in seeds
            ]
            found.append(_verdict(claim, name, np.asarray(pairs, float)))
    return found


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


def table(numbers: Numbers, still: float) -> str:
    """Means over the seeds, one row for each arm; after "±" their standard deviation.

    `still` is the end-point error of points that do not move.
    """
    widths = {name: max(len(m.heading), 7) for name, m in MEASURES.items()}
    heads = (f"{m.heading:>{widths[name]}s}" for name, m in MEASURES.items())
    lines = [f"{'':18s} " + " ".join(heads)]
    for arm in dict.fromkeys(arm for arm, _ in numbers):
        rows = [row for (name, _), row in numbers.items() if name == arm]
        means, spreads = [], []
        for name, measure in MEASURES.items():
            values = np.asarray([row[name] for row in rows], float)
            digits, width = measure.digits, widths[name]
            spread = values.std(ddof=1) if len(values) > 1 else math.nan
            mean = _cell(values.mean(), digits, width)
            if name == "track_error" and np.isnan(values).all():
                mean = f"{'still':>{width}s}"
            means.append(mean)
            spreads.append(_cell(spread, digits, width))
        lines.append(f"{arm:18s} " + " ".join(means))
        if len(rows) > 1:
            lines.append(f"{'  ± over seeds':18s} " + " ".join(spreads))
    lines.append(f"still: {still:.4f} scene units")
    return "\n".join(lines)


def _cell(value, digits, width):
    return f"{value:{width}.{digits}f}" if math.isfinite(value) else f"{'-':>{width}s}"


def claims_text(found: Sequence[Verdict]) -> str:
    """Every claim, and what each measure says of it."""
    lines, last = [], None
    for verdict in found:
        if verdict.claim is not last:
            last = verdict.claim
            lines.append(f"{last.statement}: {last.better} against {last.worse}")
        measure = MEASURES[verdict.measure]
        spread = (
            "" if math.isnan(verdict.half_width) else f" ± {verdict.half_width:.3g}"
        )
        lines.append(
            f"    {verdict.measure:20s} {verdict.better:.4g} against "
            f"{verdict.worse:.4g} {measure.unit}, gain {verdict.gain:+.3g}{spread}: "
            f"{verdict.says}"
        )
    return "\n".join(lines)
