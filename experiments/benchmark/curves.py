"""Quality over processor time: the figure of the suite `curves`, and its table."""

import math
import pathlib
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments import markdown

# Benchmark of each panel of the figure, with its title.
PANELS = {
    "--scene static --suite curves": "static scene",
    "--scene default --suite curves": "slow motion",
    "--scene fast --suite curves": "fast motion",
}
# Preset without "-small", color and line style of each method. Fields are dashed, and
# models without a motion are gray. Colors keep a contrast of at least 4 with white.
STYLES = {
    "tracked": ("splats-tracked", "#c2410c", "-"),
    "space-time": ("spacetime", "#1d6fd1", "-"),
    "deformable": ("splats-deformable", "#15803d", "-"),
    "sonata": ("sonata", "#9333ea", "-"),
    "moba": ("moba", "#db2777", "-"),
    "static": ("splats-static", "#111827", "-"),
    "d-nerf-grid": ("d-nerf-grid", "#0e7490", "--"),
    "nerf-grid": ("nerf-grid", "#6b7280", "--"),
}
TIMES = (5, 10, 20, 40, 80)  # processor seconds of the columns of the table


class Line(NamedTuple):
    """Curve of a method, over its seeds."""

    seconds: tuple[float, ...]  # of processor time, mean over the seeds
    psnr: tuple[float, ...]  # mean over the seeds, dB
    low: tuple[float, ...]  # lowest of the seeds
    high: tuple[float, ...]  # highest of the seeds


def lines(benchmark: Mapping[str, Any]) -> dict[str, Line]:
    """Average the stored curves of each method over its seeds.

    Args:
      benchmark: One benchmark of the stored results.

    Returns:
      Lines by method, without methods that have no curve. Evaluations of steps that
      another seed lacks are left out.
    """
    result = {}
    for name, method in benchmark["methods"].items():
        seeds = [_points(one) for one in method.get("curves", {}).values()]
        common = set.intersection(*map(set, seeds)) if seeds else set()
        if common:
            points = [[seed[step] for seed in seeds] for step in sorted(common)]
            scores = [[psnr for _, psnr in point] for point in points]
            result[name] = Line(
                tuple(statistics.fmean(at for at, _ in point) for point in points),
                tuple(map(statistics.fmean, scores)),
                tuple(map(min, scores)),
                tuple(map(max, scores)),
            )
    return result


def _points(curve):
    """Return processor seconds and PSNR of the evaluations of a run, by step."""
    rows = zip(curve["steps"], curve["cpu_seconds"], curve["psnr"], strict=True)
    return {step: (at, psnr) for step, at, psnr in rows if None not in (at, psnr)}


def table(benchmark: Mapping[str, Any]) -> str:
    """Format the PSNR of each method after some processor seconds.

    Args:
      benchmark: One benchmark of the stored results.

    Returns:
      Markdown, empty if there are no curves.
    """
    curves = lines(benchmark)
    heads = ("method", *(f"{at} s" for at in TIMES), "at the end", "after CPU s")
    rows = []
    for name, line in curves.items():
        cells = [markdown.number(psnr_at(line, at), 2) for at in TIMES]
        last = markdown.number(line.psnr[-1], 2), markdown.number(line.seconds[-1], 0)
        rows.append([f"`{name}`", *cells, *last])
    if not rows:
        return ""
    return (
        "PSNR of all held-out frames in dB, after so many processor seconds of "
        "training\n(interpolated over the logarithm of the time).\n\n"
        + markdown.table(heads, rows)
    )


def psnr_at(line: Line, seconds: float | int) -> float | None:
    """Interpolate a line over the logarithm of the time.

    Args:
      line: The line.
      seconds: Processor seconds.

    Returns:
      PSNR in dB, or None before the first evaluation and after the last.
    """
    if not line.seconds[0] <= seconds <= line.seconds[-1]:
        return None
    return float(np.interp(math.log(seconds), np.log(line.seconds), line.psnr))


def advice(results: Mapping[str, Any]) -> dict[str, Any]:
    """Select the curves that `nerfies_jax.evaluation.method_curves` ranks presets by.

    Args:
      results: The stored results.

    Returns:
      Mean curves over the seeds by scene, and by preset and changes.
    """
    scenes: dict[str, Any] = {}
    for label in PANELS:
        benchmark = results["benchmarks"].get(label, {"methods": {}})
        for name, line in lines(benchmark).items():
            curve = {
                "seconds": [round(at, 2) for at in line.seconds],
                "psnr": [round(psnr, 3) for psnr in line.psnr],
            }
            settings = benchmark["methods"][name]["settings"]
            scenes.setdefault(label.split()[1], {})[settings] = curve
    return scenes


def panels(results: Mapping[str, Any]) -> dict[str, dict[str, Line]]:
    """Collect what the figure shows.

    Args:
      results: The stored results.

    Returns:
      Lines by title of the panel and method, without panels that have no curves.
    """
    benchmarks = results["benchmarks"]
    all_panels = {
        title: lines(benchmarks[label])
        for label, title in PANELS.items()
        if label in benchmarks
    }
    return {title: curves for title, curves in all_panels.items() if curves}


def draw(results: Mapping[str, Any], path: pathlib.Path) -> None:
    """Plot PSNR over processor seconds, with one panel for each scene.

    Lines are means over the seeds, and bands reach from the lowest to the highest seed.

    Args:
      results: The stored results.
      path: The PNG file. Nothing is written if there are no curves.

    Raises:
      MissingExtra: If matplotlib is not installed.
    """
    from nerfies_jax.visualization import figures

    panel_list = panels(results)
    if not panel_list:
        return
    figure = figures.new_figure(figsize=(8.4, 3.7), dpi=200, layout="constrained")
    all_axes = figure.subplots(1, len(panel_list), sharey=True, squeeze=False)[0]
    for axes, (title, curves) in zip(all_axes, panel_list.items(), strict=True):
        _draw_panel(axes, title, curves)
    all_axes[0].set_ylabel("PSNR of held-out frames (dB)", fontsize=9)
    figure.supxlabel(
        "processor seconds of training, without compilation and tracking", fontsize=9
    )
    # Positions of the labels depend on the limits that all panels share.
    for axes, curves in zip(all_axes, panel_list.values(), strict=True):
        _label(axes, curves)
    figures.save(figure, path, panel_list)


def _draw_panel(axes, title, curves):
    for name, line in curves.items():
        _, color, style = STYLES[name]
        axes.fill_between(line.seconds, line.low, line.high, color=color, alpha=0.2)
        axes.plot(line.seconds, line.psnr, style, color=color, linewidth=1.6)
        axes.plot(line.seconds[-1], line.psnr[-1], "o", color=color, markersize=3)
    axes.set_xscale("log")
    first = min(line.seconds[0] for line in curves.values())
    last = max(line.seconds[-1] for line in curves.values())
    axes.set_xlim(first * 0.9, last * (last / first) ** 0.75)  # room for labels
    ticks = [at for at in (1, 3, 10, 30, 100, 300) if first <= at <= last * 1.1]
    axes.set_xticks(ticks, [f"{at}" for at in ticks])
    axes.minorticks_off()
    axes.tick_params(labelsize=8)
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _label(axes, curves):
    """Write the name of each line next to its end, without overlaps."""
    names = sorted(curves, key=lambda name: curves[name].psnr[-1])
    low, high = axes.get_ylim()
    spacing = (high - low) / 19  # height of a line of text
    heights = _spread([curves[name].psnr[-1] for name in names], spacing)
    axes.set_ylim(top=max(high, heights[-1] + spacing))
    last = max(line.seconds[-1] for line in curves.values())
    for name, height in zip(names, heights, strict=True):
        text, color, _ = STYLES[name]
        line = curves[name]
        axes.annotate(
            text,
            (line.seconds[-1], line.psnr[-1]),
            xytext=(last * 1.25, height),
            va="center",
            fontsize=7.5,
            color=color,
            arrowprops={
                "arrowstyle": "-",
                "color": color,
                "linewidth": 0.5,
                "relpos": (0, 0.5),  # begins left of the text
            },
        )


def _spread(values: Sequence[float], spacing: float) -> list[float]:
    """Move sorted values apart, to at least a spacing, by as little as possible."""
    groups: list[list[float]] = []  # values that touch each other
    for value in values:
        groups.append([value])
        while len(groups) > 1:
            below, above = (
                _positions_in_group(group, spacing) for group in groups[-2:]
            )
            if above[0] - below[-1] >= spacing:
                break
            groups[-2:] = [groups[-2] + groups[-1]]
    return [
        height for group in groups for height in _positions_in_group(group, spacing)
    ]


def _positions_in_group(group, spacing):
    """Positions of the values of a group, centered on their mean."""
    start = statistics.fmean(group) - spacing * (len(group) - 1) / 2
    return [start + spacing * k for k in range(len(group))]
