"""Radar charts of the methods of a table, as published and as measured here.

As in Figure 7 of Sonata, every axis is normalized to the lowest and the highest of the
methods.
"""

import math
import pathlib
import statistics
from collections.abc import Mapping
from typing import Any

from experiments.benchmark import claims, published
from experiments.benchmark.curves import STYLES

Scores = dict[str, tuple[float, ...]]  # of each axis, by small preset
AXES = {
    "as published: NeRF-DS": ("PSNR", "SSIM", "1 - LPIPS"),
    "here: small presets from tracks": ("PSNR", "SSIM", "moving PSNR"),
}
# Colors of methods that the figure of the curves does not have.
COLORS = {
    "tineuvox-small": "#a16207",
    "hypernerf-small": "#6b7280",
    "nerf-ds-small": "#0e7490",
    "sc-gs-small": "#1d6fd1",
    "adc-gs-small": "#c2410c",
    "4dgs-small": "#db2777",
} | {f"{name}-small": color for name, color, _ in STYLES.values()}


def panels(league: Mapping[str, Any]) -> dict[str, Scores]:
    """Collect what the figure shows.

    Args:
      league: Contents of docs/results/league.json.

    Returns:
      Normalized scores in [0, 1] by panel and method. Methods without a score of an
      axis are left out.
    """
    table = published.TABLES[0]
    scores = {table.preset: table.score, **table.others}
    known = {
        name: (one.psnr, one.ssim, 1 - one.lpips)
        for name, one in scores.items()
        if one.ssim is not None and one.lpips is not None
    }
    measured = {name: _measured(league, name) for name in scores}
    return {
        title: normalized(each)
        for title, each in zip(AXES, (known, measured), strict=True)
    }


def _measured(league, preset):
    """Mean scores of a preset over captures and seeds."""
    contests = (one for one in league["contests"] if one["film"] in claims.CAPTURES)
    cells = [
        cell["numbers"]
        for contest in contests
        for cell in claims.row_of(contest["rows"], preset, "tracks")["cells"].values()
    ]
    keys = ("psnr", "ssim", "moving_psnr")
    return tuple(statistics.fmean(cell[key] for cell in cells) for key in keys)


def normalized(scores: Scores) -> Scores:
    """Scale every axis so that the lowest score is 0 and the highest is 1.

    Args:
      scores: Scores by method.

    Returns:
      Scaled scores. An axis on which all are equal is 1.
    """
    ends = [(min(axis), max(axis)) for axis in zip(*scores.values(), strict=True)]
    return {
        name: tuple(
            (score - low) / (high - low) if high > low else 1.0
            for score, (low, high) in zip(each, ends, strict=True)
        )
        for name, each in scores.items()
    }


def draw(league: Mapping[str, Any], path: pathlib.Path) -> None:
    """Plot one triangle for each method, in one panel as published and one as measured.

    Args:
      league: Contents of docs/results/league.json.
      path: The PNG file.

    Raises:
      MissingExtra: If matplotlib is not installed.
    """
    from nerfies_jax.visualization import figures

    shown = panels(league)
    figure = figures.new_figure(figsize=(8.4, 4.2), dpi=110, layout="constrained")
    all_axes = figure.subplots(1, len(shown), subplot_kw={"projection": "polar"})
    for axes, (title, scores) in zip(all_axes, shown.items(), strict=True):
        angles = [math.pi / 2 + 2 * math.pi * k / 3 for k in range(3)]
        for name, each in scores.items():
            wide = 2.2 if name == published.TABLES[0].preset else 1.2
            axes.plot(
                [*angles, angles[0]],
                [*each, each[0]],
                color=COLORS[name],
                linewidth=wide,
                label=name.removesuffix("-small"),
            )
        axes.set_xticks(angles, AXES[title], fontsize=8)
        axes.tick_params(axis="x", pad=9)
        axes.set_yticks([0.5, 1.0], ["", ""])
        axes.set_ylim(0, 1.05)
        axes.set_title(title, fontsize=10)
    handles, labels = all_axes[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)
    figures.save(figure, path, shown)
