"""The pages of `experiments.accuracy_time` in docs/results."""

import math

from experiments import markdown
from experiments.ablate.measures import stored_means
from experiments.accuracy_time.axes import AXES

HOW = """\
## How to read

- The first table has every preset as it is. Those below change one thing in one of
  them, written as when it was measured (fields may have other names since): *time* is
  then the training time over that of the preset.
- *moves* is the PSNR of what moves, *depth* the median error of depth and *EPE* the
  mean distance of followed points from where they really are, both in scene
  units{still}.
- *CPU s* is processor time of training without compiling; each setting had one
  core{repeat}. *compile s* is what compiling took beside the other jobs of the run,
  and is paid once for each shape of a scene; the compilation cache spares it the
  second time.
- *frame ms* was taken beside other jobs: a factor of two among frame times means
  nothing.
- {seeds}
- Every setting was trained over one length, {share:g} of its preset's own steps. What
  is cheap may pass what is dear when both get the same seconds, so the line in the
  picture joins the best settings of this table, not the best that there can be:
  `python -m experiments.ablate --suite settings --seconds 60` gives all the same
  time."""

ONE_SEED = """\
There is one seed, so nothing says how far two runs of one setting lie apart: take
small differences for noise, and measure with `--seeds 3` what you want to rely on."""

NEEDS = """\
## Which setting for which need

- **A first look**: `splats-static-small` ({static_s} s of training; {static} dB), or
  `splats-deformable-small --set motion.depth=2 motion.width=48 motion.skips=`
  ({tiny_s} s; {tiny} dB).
- **The best picture in a minute, where the capture has depth**: `sonata-small --set
  motion.network=mlp` ({mlp} dB; {mlp_s} s).
- **The best picture without depth**: `splats-deformable-small` ({deform} dB); with
  `--set motion.depth=8 motion.width=256 motion.skips=5`, the paper's network, it
  gains {wide_gain} dB in {wide_times} times the training time.
- **What moves matters most**: `d-nerf-small` ({moves} dB there, the best splats
  {splats_move} dB), for {field_s} s.
- **Small files**: `d-nerf-small` holds {field_mb} MB of parameters,
  `splats-deformable-small` {splat_mb} MB."""

SKIPS = """\
(The network of 8x256 was measured with `motion.skips=4`: it read its input again one
layer before the paper's does.)"""

HEADS = ("PSNR", "SSIM", "moves", "depth", "EPE", "Gaussians", "MB", "CPU s")
# Measure, digits, divisor: columns of every table.
COLUMNS = (
    ("psnr", 2, 1),
    ("ssim", 3, 1),
    ("moving_psnr", 2, 1),
    ("depth_median", 4, 1),
    ("track_error", 4, 1),
    ("gaussians", 0, 1),
    ("parameters", 2, 2.5e5),  # MB of four bytes each
)


def page(stored) -> str:
    """Everything below the docstring, from an accuracy_time.json."""
    means = stored_means(stored["metrics"])
    about = stored["about"]
    seconds = _seconds(about)
    still = stored["metrics"]["still.track_error"]["value"]
    parts = [
        HOW.format(
            still="" if still is None else f";\n  points at rest have {still:.4f}",
            repeat=_repeat(means, seconds),
            share=_asked(about, "share"),
            seeds=ONE_SEED
            if _asked(about, "seeds") == 1
            else "Numbers are means over the seeds.",
        ),
        f"## The presets on {about['capture']}",
        _presets(means, seconds),
    ]
    for name, axis in AXES.items():
        chosen = [s for s in axis.settings if s in means and s != axis.base]
        if name != "preset" and chosen and axis.base in means:
            parts.append(f"## {axis.question[0].upper()}{axis.question[1:]}")
            parts.append(_axis(axis.base, chosen, means, about, seconds))
    if {"kan-mlp", "motion-2x48", "motion-8x256", "d-nerf-small"} <= means.keys():
        parts.append(_needs(means, seconds))
        if "motion.skips=4" in about["arms"]["motion-8x256"]["changes"]:
            parts.append(SKIPS)
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
    same = means.get("splats-products-bfloat16")
    base = means.get("splats-deformable-small")
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


def _asked(about, name):
    return about["settings"][name]


def _row(row, seconds):
    cells = [markdown.number(row[key] / by, digits) for key, digits, by in COLUMNS]
    return [*cells, markdown.number(row[seconds], 0)]


def _presets(means, seconds):
    rows = [
        [
            f"`{name}`",
            *_row(means[name], seconds),
            markdown.number(means[name]["compile_seconds"], 0),
            markdown.number(means[name]["render_ms"], 0),
        ]
        for name in AXES["preset"].settings
        if name in means
    ]
    return markdown.table(("preset", *HEADS, "compile s", "frame ms"), rows)


def _axis(base, chosen, means, about, seconds):
    """The base first; what was set in the others as the file has it, not the code."""
    rows = [[f"`{base}`", *_row(means[base], seconds), "1.00"]]
    for name in chosen:
        arm = about["arms"][name]
        what = " ".join((*arm["changes"], *arm["environment"]))
        ratio = means[name][seconds] / means[base][seconds]
        rows.append(
            [f"`{what}`", *_row(means[name], seconds), markdown.number(ratio, 2)]
        )
    return markdown.table(("setting", *HEADS, "time"), rows)


def _needs(means, seconds):
    def took(name):
        return markdown.number(means[name][seconds], 0)

    def psnr(name):
        return markdown.number(means[name]["psnr"], 2)

    deform, wide = means["splats-deformable-small"], means["motion-8x256"]
    splats = [row for row in means.values() if math.isfinite(row["gaussians"])]
    return NEEDS.format(
        static=psnr("splats-static-small"),
        static_s=took("splats-static-small"),
        tiny=psnr("motion-2x48"),
        tiny_s=took("motion-2x48"),
        mlp=psnr("kan-mlp"),
        mlp_s=took("kan-mlp"),
        deform=psnr("splats-deformable-small"),
        wide_gain=markdown.number(wide["psnr"] - deform["psnr"], 2),
        wide_times=markdown.number(wide[seconds] / deform[seconds], 2),
        moves=markdown.number(means["d-nerf-small"]["moving_psnr"], 2),
        splats_move=markdown.number(max(row["moving_psnr"] for row in splats), 2),
        field_s=took("d-nerf-small"),
        field_mb=markdown.number(means["d-nerf-small"]["parameters"] / 2.5e5, 2),
        splat_mb=markdown.number(deform["parameters"] / 2.5e5, 2),
    )
