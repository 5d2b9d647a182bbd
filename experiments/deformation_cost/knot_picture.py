"""The figure of experiments.deformation_cost."""

import pathlib

from experiments.deformation_cost.knot_curve import Curve
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.evaluation import figures

COLORS = {"linear": "tab:orange", "cubic": "tab:blue"}


def save(path: pathlib.Path, rows: list[dict], curve: Curve) -> None:
    """Times of all arms, and error and picture quality against the number of knots."""
    figure = figures.new_figure(figsize=(15, 5), layout="constrained")
    bars, errors, quality = figure.subplots(1, 3, width_ratios=(1.5, 1, 1))
    _bars(bars, rows)
    for way, color in COLORS.items():
        points = [point for point in curve.points if point.interpolation == way]
        knots = [point.knots for point in points]
        errors.loglog(
            *(knots, [p.largest for p in points], "--"),
            color=color,
            label=f"{way}, largest",
        )
        errors.loglog(
            *(knots, [p.rms for p in points], "o-"), color=color, label=f"{way}, RMS"
        )
        times = [point.cpu_ms for point in points]
        quality.plot(times, [p.psnr for p in points], "o-", color=color, label=way)
        for point in points:
            quality.annotate(
                f"{point.knots}", (point.cpu_ms, point.psnr), (4, -10), fontsize=8,
                textcoords="offset points",
            )  # fmt: skip
    errors.set_xticks(knots, [str(count) for count in knots])
    errors.minorticks_off()
    errors.set(
        xlabel="knots", ylabel="position error / size of the motion", title=curve.name
    )
    quality.axvline(
        curve.exact_cpu_ms, color="gray", linestyle=":", label="the network"
    )
    quality.set(
        xlabel="ms of one core for an instant (labels: knots)",
        xscale="log",
        ylabel="PSNR of the frame against the network's (dB)",
        title=f"{curve.gaussians} Gaussians, {curve.moving} moving",
    )
    ticks = figures.library("matplotlib.ticker").LogLocator(subs=(1, 2, 5))
    quality.xaxis.set_major_locator(ticks)
    quality.xaxis.set_major_formatter("{x:g}")
    quality.xaxis.set_minor_formatter("")
    for axes in (errors, quality):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    with replaced_file(path) as partial:
        figure.savefig(partial, dpi=100)


def _bars(axes, rows):
    names = [row["name"] for row in rows]
    for kind, shift, color in (
        ("forward", -0.2, "tab:green"),
        ("both", 0.2, "tab:gray"),
    ):
        there = [k for k, row in enumerate(rows) if row[f"{kind}_cpu_ms"] is not None]
        values = [rows[k][f"{kind}_cpu_ms"] for k in there]
        label = "forward" if kind == "forward" else "and backward"
        bars = axes.barh(
            [k + shift for k in there], values, 0.4, color=color, label=label
        )
        axes.bar_label(bars, fmt="%.3g", padding=3, fontsize=7)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.invert_yaxis()
    axes.set(
        xscale="log",
        xlabel="ms of one core",
        title="deforming 10,000 Gaussians",
    )
    axes.margins(x=0.15)
    axes.legend(fontsize=8)
