"""The page of `experiments.growth` in docs/results, and its figure."""

import pathlib
from collections.abc import Mapping
from typing import Any

from experiments import markdown
from experiments.growth.axes import AXES, fit

STEPS = 30_000  # of a run at the size of the papers
CLIP_FRAMES, CLIP_PIXELS = 300 * 30, 1920 * 1080  # five minutes at 30 frames per second
CLIP_GB = 3 * CLIP_FRAMES * CLIP_PIXELS / 1e9
CAPTURES = 1_000
QUANTITIES = {
    "cpu_seconds": "time",
    "memory": "memory",
    "pairs": "pairs",
    "flops": "flops",
    "bytes_accessed": "bytes",
}
EXPONENTS = """\
Exponents of power laws, fitted by least squares, with their standard error. *Steepest*
is the largest exponent of time between two neighboring sizes. It is the one to compare
with 1, because a constant part of a step hides the growth at small sizes."""
GOALS = f"""\
A run has {STEPS:,} steps of one view, on one core. The clip has {CLIP_FRAMES:,} frames,
which are streamed from {CLIP_GB:.0f} GB on disk, and 10,000 Gaussians."""


def page(results: Mapping[str, Any]) -> str:
    """Format the exponents, the measurements and the limits of large scenes.

    Args:
      results: The stored results.

    Returns:
      Markdown.
    """
    axes = collect_points(results)
    steepest = {
        name: fit(points, "cpu_seconds").steepest for name, points in axes.items()
    }
    worst = max(steepest, key=lambda name: steepest[name])
    parts = [
        f"Time grows fastest with {worst}: its exponent is at most "
        f"{markdown.number(steepest[worst])} between two sizes."
    ]
    goals = _goals(results, axes)
    if goals:
        parts += ["## First limits of large scenes", GOALS, goals]
    parts += ["## Exponents", EXPONENTS, _exponents(axes)]
    parts += ["## Measurements", _measurements(axes)]
    return "\n\n".join(parts)


def collect_points(
    results: Mapping[str, Any],
) -> dict[str, dict[str, dict[str, float]]]:
    """Return the measurements in the order of `AXES`, with the memory of a step.

    Args:
      results: The stored results.

    Returns:
      Measurements by axis and size.
    """
    return {
        name: {
            size: point | {"memory": point["temporary_bytes"] + point["input_bytes"]}
            for size, point in sorted(results["axes"][name].items(), key=_size)
        }
        for name in AXES
        if name in results["axes"]
    }


def _size(item):
    return int(item[0])


def _exponents(axes):
    heads = (
        "growing",
        "scene",
        "sizes",
        "time",
        "steepest",
        *[*QUANTITIES.values()][1:],
    )
    rows = []
    for name, points in axes.items():
        fits = {key: fit(points, key) for key in QUANTITIES}
        cells = [markdown.with_spread(x.exponent, x.error, 2) for x in fits.values()]
        cells.insert(1, markdown.number(fits["cpu_seconds"].steepest))
        sizes = sorted(map(int, points))
        span = f"{sizes[0]:,} to {sizes[-1]:,}"
        rows.append([name, AXES[name].about, span, *cells])
    return markdown.table(heads, rows, words=3)


def _measurements(axes):
    heads = ("growing", "size", "CPU ms a step", "memory MB", "pairs")
    heads += ("Mflops", "MB accessed")
    rows = []
    for name, points in axes.items():
        for size, point in points.items():
            cells = (
                1e3 * point["cpu_seconds"],
                point["memory"] / 1e6,
                point.get("pairs"),
                point["flops"] / 1e6,
                point["bytes_accessed"] / 1e6,
            )
            rows.append([name, f"{int(size):,}", *map(markdown.short, cells)])
    return markdown.table(heads, rows, words=1)


def _goals(results, axes):
    """Format what limits a long clip, many Gaussians and many captures."""
    clip = axes.get("pixels, 10,000 Gaussians", {}).get(str(CLIP_PIXELS))
    many = axes.get("Gaussians", {}).get("1000000")
    available = results["machine"]["memory_bytes"]
    rows = []
    if clip is not None:
        goal = "five minutes of 1920x1080"
        rows.append(_goal(goal, clip, clip["memory"], available))
    if many is not None:
        goal = "1,000,000 Gaussians, 352x264 pixels"
        rows.append(_goal(goal, many, many["memory"], available))
    hours = CAPTURES * results["job_seconds"] / 3600
    goal = f"{CAPTURES:,} captures with the default command"
    share = results["train_seconds"] / results["job_seconds"]
    limit = f"time, of which training is {100 * share:.0f} %"
    rows.append([goal, limit, "", markdown.number(hours, 0), ""])
    heads = ("goal", "first limit", "s a step", "hours", "memory GB")
    return markdown.table(heads, rows, words=2)


def _goal(goal, point, memory_bytes, available):
    seconds = point["cpu_seconds"]
    limit = "time of a step"
    if memory_bytes > available:
        limit = f"memory: the measured machine has {available / 1e9:.0f} GB"
    return [
        goal,
        limit,
        markdown.short(seconds),
        markdown.number(seconds * STEPS / 3600, 0),
        markdown.number(memory_bytes / 1e9, 1),
    ]


def draw(results: Mapping[str, Any], path: pathlib.Path) -> None:
    """Plot time and memory over all sizes, each relative to the smallest.

    Args:
      results: The stored results.
      path: The PNG file.

    Raises:
      MissingExtra: If matplotlib is not installed.
    """
    from nerfies_jax.visualization import figures

    plotted_axes = collect_points(results)
    figure = figures.new_figure(figsize=(8.4, 3.9), dpi=200, layout="constrained")
    panels = figure.subplots(1, 2, sharex=True)
    titles = {"cpu_seconds": "time of a step", "memory": "memory of a step"}
    for axes, (key, title) in zip(panels, titles.items(), strict=True):
        most = 1.0
        for name, points in plotted_axes.items():
            sizes = [int(size) / int(next(iter(points))) for size in points]
            values = [point[key] for point in points.values()]
            relative = [value / values[0] for value in values]
            axes.plot(sizes, relative, "o-", markersize=3, linewidth=1.5, label=name)
            most = max(most, *sizes)
        axes.plot([1, most], [1, most], ":", color="#6b7280", label="linear")
        axes.set(xscale="log", yscale="log", title=title)
        axes.title.set_fontsize(10)
        axes.tick_params(labelsize=8)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend(fontsize=7, frameon=False)
    panels[0].set_ylabel("relative to the smallest size", fontsize=9)
    figure.supxlabel("size, relative to the smallest", fontsize=9)
    figures.save(figure, path, plotted_axes)
