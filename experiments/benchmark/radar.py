"""Radar charts of Sonata and what it is compared with, as published and as measured.

As in Figures 3 and 7 of the paper, every axis is normalized to the lowest and the
highest of the methods.
"""

import math
import pathlib
import statistics
from collections.abc import Mapping
from typing import Any, NamedTuple

from experiments.benchmark import claims, published
from experiments.benchmark.published import Score

Scores = dict[str, tuple[float, ...]]  # of each axis, by method
OURS = ("PSNR", "SSIM", "moving PSNR")
PUBLISHED = ("PSNR", "SSIM", "1 - LPIPS")
COLORS = (
    *("#9333ea", "#111827", "#a16207", "#6b7280", "#0e7490"),
    *("#15803d", "#1d6fd1", "#c2410c", "#db2777"),
)


class Panel(NamedTuple):
    """One chart."""

    title: str
    axes: tuple[str, ...]
    scores: Scores  # normalized, in [0, 1]


def panels(league: Mapping[str, Any], ablation: Mapping[str, Any]) -> list[Panel]:
    """Collect what the figure shows.

    Args:
      league: Contents of docs/results/league.json.
      ablation: Contents of experiments/measured/ablate_sonata.json.

    Returns:
      Charts of the methods of Table 1 and of the ablation, each as published and as
      measured here. Methods without a published score of an axis are left out there.
    """
    table, parts = published.TABLES[0], published.ABLATIONS[0]
    methods = {table.preset: table.score, **table.others}
    ablation_scores = {"full": parts.score} | {
        one.worse: one.score for one in parts.parts
    }
    (benchmark,) = ablation["benchmarks"].values()
    of_parts = {name: benchmark["methods"][name]["mean"] for name in ablation_scores}
    keys = ("heldout.psnr", "heldout.ssim", "heldout.moving_psnr")
    return [
        Panel("Table 1, as published", PUBLISHED, normalize(_select_complete(methods))),
        Panel(
            "the same small presets here",
            OURS,
            normalize({name: _mean_scores(league, name) for name in methods}),
        ),
        Panel(
            "ablation, as published",
            PUBLISHED,
            normalize(_select_complete(ablation_scores)),
        ),
        Panel(
            "the same ablation here",
            OURS,
            normalize(
                {name: tuple(m[key] for key in keys) for name, m in of_parts.items()}
            ),
        ),
    ]


def _select_complete(scores: Mapping[str, Score]) -> Scores:
    return {
        name: (one.psnr, one.ssim, 1 - one.lpips)
        for name, one in scores.items()
        if one.ssim is not None and one.lpips is not None
    }


def _mean_scores(league, preset):
    """Mean scores of a preset over captures and seeds."""
    contests = (one for one in league["contests"] if one["capture"] in claims.CAPTURES)
    cells = [
        cell["numbers"]
        for contest in contests
        for cell in claims.row_of(contest["rows"], preset, "tracks")["cells"].values()
    ]
    keys = ("psnr", "ssim", "moving_psnr")
    return tuple(statistics.fmean(cell[key] for cell in cells) for key in keys)


def normalize(scores: Scores) -> Scores:
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


def draw(
    league: Mapping[str, Any], ablation: Mapping[str, Any], path: pathlib.Path
) -> None:
    """Plot one triangle for each method in each chart.

    Args:
      league: Contents of docs/results/league.json.
      ablation: Contents of experiments/measured/ablate_sonata.json.
      path: The PNG file.

    Raises:
      MissingExtra: If matplotlib is not installed.
    """
    from nerfies_jax.visualization import figures

    panel_list = panels(league, ablation)
    figure = figures.new_figure(figsize=(8.4, 7.6), dpi=110, layout="constrained")
    rows = figure.subfigures(2, 1)
    for row, pair in zip(rows, (panel_list[:2], panel_list[2:]), strict=True):
        all_axes = row.subplots(1, 2, subplot_kw={"projection": "polar"})
        colors = dict(zip(pair[1].scores, COLORS, strict=False))
        for axes, panel in zip(all_axes, pair, strict=True):
            _draw_panel(axes, panel, colors)
        handles, labels = all_axes[-1].get_legend_handles_labels()
        row.legend(handles, labels, loc="outside right center", fontsize=8)
    figures.save(figure, path, panel_list)


def _draw_panel(axes, panel, colors):
    angles = [math.pi / 2 + 2 * math.pi * k / 3 for k in range(3)]
    for name, scores in panel.scores.items():
        axes.plot(
            [*angles, angles[0]],
            [*scores, scores[0]],
            color=colors[name],
            linewidth=2.2 if name in ("sonata-small", "full") else 1.2,
            label=name.removesuffix("-small"),
        )
    axes.set_xticks(angles, panel.axes, fontsize=8)
    axes.tick_params(axis="x", pad=9)
    axes.set_yticks([0.5, 1.0], ["", ""])
    axes.set_ylim(0, 1.05)
    axes.set_title(panel.title, fontsize=10)
