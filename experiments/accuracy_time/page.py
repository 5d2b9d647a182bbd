"""The pages of `experiments.accuracy_time` in docs/results."""

import math

from experiments import markdown
from experiments.ablate.measures import stored_means
from experiments.accuracy_time.axes import AXES, SPLATS

HOW = """\
## How to read

- A table changes one thing in a preset, which is its first row: *time* is the training
  time over that of the first. What moves is fitted to tracks before training, but where
  a setting says otherwise; neither finding tracks nor fitting to them is in the
  seconds.
- *moves* is the PSNR of what moves, *depth* the median error of depth and *EPE* the
  mean distance of followed points from where they really are, both in scene
  units{still}.
- *CPU s* is processor time of training without compiling; each setting had one
  core{repeat}.
- {seeds}
- Every setting was trained over one length, {share:g} of its preset's own steps, or as
  many times that as it says. What is cheap may pass what is dear when both get the same
  seconds: of presets that is in [league.md](league.md), of settings
  `python -m experiments.ablate --suite settings --seconds 60` tells it."""

ONE_SEED = """\
There is one seed, so nothing says how far two runs of one setting lie apart: take
small differences for noise, and measure with `--seeds 3` what you want to rely on."""

SEEDS = """\
Numbers are means over {count:g} seeds, ± their standard deviation."""

SHORT = """\
## In short

Of `{base}`, {base_psnr} dB in {base_s} s:

- **Time**: {quarter_psnr} dB after {quarter_s} s, {half_psnr} after {half_s},
  {double_psnr} after {double_s}. Twice the Gaussians ({more_psnr} dB in {more_s} s) or
  twice the views in a step ({views_psnr} in {views_s}) buy what twice the steps do.
- **What can go**: harmonics (`sh_degree=0`: {flat_psnr} dB and {flat_mb} MB for
  {base_mb}), growth ({grown_psnr}), D-SSIM ({plain_psnr}).
- **What cannot**: the start from tracks ({rest_psnr} dB from rest, {still_psnr}
  without any motion, both without the random points that stand in for tracks today:
  [league.md](league.md), row `splats-tracked-small+rest`), a third basis of motion and
  more ({two_psnr} with two, {many_psnr} with sixteen), what is seen through a hundredth
  of light ({cut_psnr} where that ends a pixel).
- **Float64** takes {wide_times} times as long and gives {wide_psnr} dB."""
SHOWN = {  # words of `SHORT`, the setting they are of
    "base": SPLATS,
    "quarter": "steps-0.25",
    "half": "steps-0.5",
    "double": "steps-2",
    "more": "most-20000",
    "views": "views-4",
    "flat": "sh-0",
    "grown": "no-growth",
    "plain": "dssim-0",
    "rest": "from-rest",
    "still": "no-motion",
    "two": "bases-2",
    "many": "bases-16",
    "cut": "stop-1e-2",
    "wide": "splats-float64",
}

HEADS = ("PSNR", "SSIM", "moves", "depth", "EPE", "Gaussians", "MB", "CPU s")
# Measure and digits: columns of every table.
COLUMNS = (
    ("psnr", 2),
    ("ssim", 3),
    ("moving_psnr", 2),
    ("depth_median", 4),
    ("track_error", 4),
    ("gaussians", 0),
    ("model_mb", 2),
)


def page(stored) -> str:
    """Everything below the docstring, from an accuracy_time.json."""
    means = stored_means(stored["metrics"])
    spreads = stored_means(stored["metrics"], spread=True)
    about = stored["about"]
    seconds, seeds = _seconds(about), about["settings"]["seeds"]
    still = stored["metrics"]["still.track_error"]["value"]
    parts = [
        HOW.format(
            still="" if still is None else f";\n  points at rest have {still:.4f}",
            repeat=_repeat(means, seconds),
            share=about["settings"]["share"],
            seeds=ONE_SEED if seeds == 1 else SEEDS.format(count=seeds),
        )
    ]
    if set(SHOWN.values()) <= means.keys():
        parts.append(_short(means, seconds))
    for axis in AXES.values():
        chosen = [s for s in axis.settings if s in means and s != axis.base]
        if chosen and axis.base in means:
            parts.append(f"## {axis.question[0].upper()}{axis.question[1:]}")
            parts.append(_axis(axis.base, chosen, means, spreads, about, seconds))
    return "\n\n".join(parts)


def draw(stored, path) -> None:
    """The fronts of what is known of the pictures, against what training takes."""
    from experiments.accuracy_time import report

    means = stored_means(stored["metrics"])
    known = [
        name
        for name in ("psnr", "moving_psnr")
        if any(math.isfinite(row[name]) for row in means.values())
    ]
    costs = (_seconds(stored["about"]), "parameters")
    report.save_fronts(path, stored["about"]["capture"], means, known, costs)


def _repeat(means, seconds):
    """How well times repeat, where one program was timed twice."""
    same, base = means.get("splats-products-bfloat16"), means.get(SPLATS)
    if same is None or base is None or same["psnr"] != base["psnr"]:
        return ""
    return (
        ". The hint of bfloat16 products,\n  which XLA for CPUs does not take, gave "
        f"the same numbers in {same[seconds] / base[seconds]:.2f} of the time: no "
        "better do times\n  repeat here"
    )


def _seconds(about):
    on_cpu = about["machine"]["backend"] == "cpu"
    return "train_cpu_seconds" if on_cpu else "train_seconds"


def _axis(base, chosen, means, spreads, about, seconds):
    """The base first; what was set in the others as the file has it, not the code."""
    start = about["arms"][base]["changes"]
    rows = []
    for name in (base, *chosen):
        arm, row, spread = about["arms"][name], means[name], spreads.get(name, {})
        cells = [
            markdown.with_spread(row[key], spread.get(key, math.nan), digits)
            for key, digits in COLUMNS
        ]
        took = markdown.number(row[seconds], 0)
        ratio = markdown.number(row[seconds] / means[base][seconds], 2)
        rows.append([_title(name == base, arm, start), *cells, took, ratio])
    return markdown.table(("setting", *HEADS, "time"), rows)


def _short(means, seconds):
    words = {}
    for word, name in SHOWN.items():
        row = means[name]
        words[f"{word}_psnr"] = markdown.number(row["psnr"], 2)
        words[f"{word}_s"] = markdown.number(row[seconds], 0)
        words[f"{word}_mb"] = markdown.number(row["model_mb"], 2)
        times = row[seconds] / means[SPLATS][seconds]
        words[f"{word}_times"] = markdown.number(times, 1)
    return SHORT.format(**words | {"base": SPLATS})


def _title(is_base, arm, start):
    """As on the command line; of a setting what the base has not set."""
    words = [word for word in arm["changes"] if is_base or word not in start]
    words += arm["environment"]
    if is_base and words:
        words.insert(0, "--set")
    share = arm.get("share", 1)
    if share != 1:
        words.append(f"{share:g} times the steps")
    if is_base or not words:
        words.insert(0, arm["preset"])
    return f"`{' '.join(words)}`"
