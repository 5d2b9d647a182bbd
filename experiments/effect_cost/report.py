"""Table, metrics and figure of `experiments.effect_cost`."""

import pathlib
from collections.abc import Mapping

import numpy as np

from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.metrics import clock
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.visualization import figures

# (field of `Priced`, unit, share of the new value by which it may be above the old, so
# that a half is twice as much). Counts repeat exactly under one version of XLA; times
# are those of one machine.
MEASURES = (
    ("flops", "flop", 0.005),
    ("bytes_accessed", "bytes", 0.005),
    ("temporary_bytes", "bytes", 0.02),
    ("matrix_flops", "flop", 0.001),
    ("compile_seconds", "s", 0.5),
    ("seconds", "s", 0.5),
)
RATIO_TOLERANCE = 0.25  # of a time over that of the bare scene of the same run
PAGE_HEADS = (
    *("scene", "parameters", "Mflop", "matmul Mflop", "MB", "temporary MB"),
    *("compile s", "step ms", "over bare"),
)
MILLIONS = ("flops", "matrix_flops", "bytes_accessed", "temporary_bytes")
PAGE_KEYS = ("parameters", *(f"step.{x}" for x in MILLIONS))
PAGE_KEYS += ("step.compile_seconds", "step.seconds", "step.over_bare")
COLORS = {"loss": "#8fb8de", "step": "#0a5fb4"}
WIDTHS = (21, 10, 8, 8, 9, 9, 8, 8, 8, 8, 7, 7, 8, 8)


def heading() -> str:
    """Explain the columns, and name the machine."""
    machine = clock.machine()
    return (
        f"On {machine['cpu']}, {machine['backend']}, JAX {machine['jax']}, "
        f"{machine['xla_cores'] or machine['cores']} core(s). Each pair of columns: "
        "the loss alone, and the training step.\n"
        "Mflop and MB are XLA's count of one call, in which a loop's body counts once "
        "however often it runs: the\nblending of Gaussians and the networks that move "
        "them in blocks are undercounted. Matmul Mflop has the matrix\nproducts alone, "
        "with all rounds of loops whose number is known (+: and more in others). The "
        "last columns are\nthe step's price: its time less that of the scene named, "
        "and the ratio of both. Times are the processor's."
    )


def table(preset, rows) -> str:
    """All scenes of one preset."""
    names = (
        *("", "parameters", "Mflop", "", "matmul", "", "MB", "", "temp MB", ""),
        *("comp. s", "", "CPU ms", ""),
    )
    lines = [f"\n{preset}", _line(names) + "   price"]
    by_name = {row.arm.name: row for row in rows}
    for row in rows:
        loss, step = row.programs["loss"], row.programs["step"]
        cells = [row.arm.name, f"{row.parameters:,}"]
        cells += [_number(x.flops / 1e6) for x in (loss, step)]
        cells += [
            _number(x.matrix_flops / 1e6) + "+" * x.at_least for x in (loss, step)
        ]
        cells += [_number(x.bytes_accessed / 1e6) for x in (loss, step)]
        cells += [_number(x.temporary_bytes / 1e6) for x in (loss, step)]
        cells += [f"{x.compile_seconds:.1f}" for x in (loss, step)]
        cells += [_number(1e3 * x.seconds) for x in (loss, step)]
        lines.append(f"{_line(cells)}   {_price(row, by_name)}".rstrip())
    return "\n".join(lines)


def _price(row, by_name):
    if row.arm.base is None:
        return ""
    others = by_name[row.arm.base]
    against = f"over {row.arm.base}"
    if row.arm.name.startswith("without "):  # what is left out, beside the others
        row, others, against = others, row, f"{row.arm.base} over {row.arm.name}"
    here, there = (x.programs["step"].seconds for x in (row, others))
    return f"{1e3 * (here - there):+.1f} ms {against}, x{here / there:.2f}"


def _line(cells):
    name, *numbers = zip(cells, WIDTHS, strict=True)
    aligned = [f"{cell:>{width}}" for cell, width in numbers]
    return " ".join([f"{name[0]:<{name[1]}}", *aligned])


def _number(value):
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def metrics_of(rows) -> list[Metric]:
    """Collect every number of every table.

    Args:
      rows: Rows by preset.

    Returns:
      Metrics by key.
    """
    metrics = []
    for preset, scenes in rows.items():
        bare = scenes[0]
        for row in scenes:
            stem = f"{preset}.{row.arm.name.replace(' + ', '_and_').replace(' ', '_')}"
            metrics.append(
                Metric(f"{stem}.parameters", row.parameters, "numbers", "lower")
            )
            for name, priced in row.programs.items():
                for field, unit, share in MEASURES:
                    value = getattr(priced, field)
                    metrics.append(
                        Metric(
                            f"{stem}.{name}.{field}",
                            value,
                            unit,
                            "lower",
                            share * value if np.isfinite(value) else 0.0,
                        )
                    )
                ratio = priced.seconds / bare.programs[name].seconds
                key = f"{stem}.{name}.over_bare"
                tolerance = RATIO_TOLERANCE * ratio
                metrics.append(Metric(key, ratio, "", "lower", tolerance))
    return metrics


def page(metrics: Mapping[str, Metric]) -> list[str]:
    """Tables in Markdown of a training step, from what effect_cost.json holds."""
    scenes: dict[str, list[str]] = {}
    for key in metrics:
        preset, arm, *rest = key.split(".")
        if rest == ["parameters"]:
            scenes.setdefault(preset, []).append(arm)
    lines = []
    for preset, arms in scenes.items():
        lines += ["", f"### `{preset}`", "", "| " + " | ".join(PAGE_HEADS) + " |"]
        lines.append("|---|" + "---:|" * (len(PAGE_HEADS) - 1))
        for arm in arms:
            value = {key: metrics[f"{preset}.{arm}.{key}"].value for key in PAGE_KEYS}
            cells = [_title(arm), f"{int(value['parameters']):,}"]
            cells += [_number(value[f"step.{x}"] / 1e6) for x in MILLIONS]
            cells.append(f"{value['step.compile_seconds']:.0f}")
            cells.append(_number(1e3 * value["step.seconds"]))
            cells.append(f"{value['step.over_bare']:.2f}")
            lines.append("| " + " | ".join(cells) + " |")
    return lines[1:]


def _title(arm):
    """Convert a key of the metrics to the name in the table."""
    for word in ("only", "without"):
        if arm.startswith(f"{word}_"):
            return f"{word} {arm.removeprefix(f'{word}_')}"
    return arm.replace("_and_", " + ")


def write(folder: pathlib.Path, rows, args) -> list[Metric]:
    """Write effect_cost.json, .md and .png.

    Args:
      folder: Folder to write to.
      rows: Rows by preset.
      args: Options.

    Returns:
      The metrics.
    """
    metrics = metrics_of(rows)
    about = {
        "presets": list(args.presets),
        "at": args.at,
        "rows": args.rows,
        "rays": args.rays,
        "repeats": args.repeats,
        "counts": "XLA's, a loop's body once; matrix_flops with every known round",
        **clock.machine(),
    }
    clock.write_metrics(folder / "effect_cost.json", metrics, about)
    save_figure(folder / "effect_cost.png", rows)
    lines = page({metric.key: metric for metric in metrics})
    with replaced_file(folder / "effect_cost.md") as partial:
        partial.write_text("\n".join(lines) + "\n")
    return metrics


def save_figure(path: pathlib.Path, rows) -> None:
    """Bars of processor time: a panel for each preset, a pair of bars for a scene."""
    heights = [len(scenes) for scenes in rows.values()]
    figure = figures.new_figure(figsize=(8, 0.32 * sum(heights) + 0.9 * len(rows)))
    figure.set_layout_engine("constrained")
    panels = figure.subplots(
        len(rows), 1, squeeze=False, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    for panel, (preset, scenes) in zip(panels, rows.items(), strict=True):
        places = np.arange(len(scenes))
        for offset, name in ((-0.2, "loss"), (0.2, "step")):
            times = [1e3 * row.programs[name].seconds for row in scenes]
            panel.barh(places + offset, times, 0.4, color=COLORS[name], label=name)
        base = scenes[0].programs["step"].seconds
        for place, row in zip(places, scenes, strict=True):
            step = row.programs["step"].seconds
            panel.text(
                1e3 * step, place + 0.2, f" x{step / base:.2f}", va="center", fontsize=8
            )
        panel.set_yticks(places, [row.arm.name for row in scenes], fontsize=8)
        panel.invert_yaxis()
        panel.margins(x=0.12)
        panel.set_title(preset, loc="left", fontsize=10)
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(axis="x", alpha=0.3)
    panels[0].legend(fontsize=8)
    panels[-1].set_xlabel(
        "milliseconds of one core; x: step over that of the bare scene"
    )
    with replaced_file(path) as file:
        figure.savefig(file, dpi=110, format="png")
