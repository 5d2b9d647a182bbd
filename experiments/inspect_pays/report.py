"""Verdicts, table and metrics of `experiments.inspect_pays`."""

import math
import pathlib
from typing import Any

from experiments.inspect_pays.job import Comparison
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.measure import clock
from nerfies_jax.measure.clock import Metric

# Less than this is the spread of seeds in runs of a few hundred steps, and of the
# processor time of the same program on a shared machine.
PSNR_DB = 0.25
TIME_SHARE = 0.1
DEPTH_SHARE = 0.2  # of the median depth error


def verdict(row: Comparison) -> str:
    """Whether the advice paid, by quality and by time, in a few words."""
    if row.same:
        return "nothing to change"
    if row.refused and row.after is not None:
        return "yes: the preset cannot be built"
    if row.before is None or row.after is None:
        return "not trained yet"
    if not (math.isfinite(row.before.psnr) and math.isfinite(row.after.psnr)):
        return "a run blew up"
    gain, what = _quality(row.before, row.after)
    ratio = row.after.seconds / row.before.seconds
    quicker, slower = ratio < 1 - TIME_SHARE, ratio > 1 + TIME_SHARE
    if gain > 0:
        return f"yes: better {what}, quicker" if quicker else f"yes: better {what}"
    if gain < 0:
        return f"no: worse {what}, quicker" if quicker else f"no: worse {what}"
    if quicker:
        return "yes: as good, quicker"
    return "no: as good, slower" if slower else "neither way"


def _quality(before, after):
    """1 for better, -1 for worse, 0 for neither, and by what; pictures come first."""
    gain = after.psnr - before.psnr
    if abs(gain) > PSNR_DB:
        return math.copysign(1, gain), "pictures"
    ratio = after.depth / before.depth  # NaN where the depth is not known
    if ratio < 1 - DEPTH_SHARE:
        return 1, "depth"
    return (-1 if ratio > 1 + DEPTH_SHARE else 0), "depth"


def table(rows: list[Comparison]) -> list[str]:
    """Lines of Markdown."""
    heads = ("capture", "preset", "advised", "PSNR", "as advised", "depth error")
    heads += ("as advised", "CPU s", "as advised", "pays")
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row in rows:
        cells = [row.capture, f"`{row.preset}`", f"`{changes(row)}`"]
        if row.same:
            cells[2] = "the same"
        for digits, field in ((2, "psnr"), (4, "depth"), (0, "seconds")):
            for side in (row.before, row.after):
                value = math.nan if side is None else getattr(side, field)
                cells.append(f"{value:.{digits}f}" if math.isfinite(value) else "-")
        lines.append("| " + " | ".join([*cells, verdict(row)]) + " |")
    return lines


def changes(row: Comparison) -> str:
    """What the advice has beside the preset, or instead of it."""
    preset, *overrides = row.advised.split("+")
    words = overrides if preset == row.preset else [preset, *overrides]
    return " ".join(words)


def metrics_of(rows: list[Comparison]) -> list[Metric]:
    """What was measured of every pair that was trained."""
    metrics = []
    for row in rows:
        if row.same or row.before is None or row.after is None:
            continue
        stem = f"{row.capture}.{row.preset}"
        gain = row.after.psnr - row.before.psnr
        ratio = row.after.seconds / row.before.seconds
        metrics += [
            Metric(f"{stem}.psnr", row.before.psnr, "dB", "higher", 0.5),
            Metric(f"{stem}.advised_psnr", row.after.psnr, "dB", "higher", 0.5),
            Metric(f"{stem}.gain", gain, "dB", "higher", 2 * PSNR_DB),
            Metric(f"{stem}.depth", row.before.depth, "scene units", "lower", 0.005),
            Metric(
                f"{stem}.advised_depth", row.after.depth, "scene units", "lower", 0.005
            ),
            Metric(f"{stem}.time_ratio", ratio, "", "lower", TIME_SHARE),
        ]
    return metrics


def write(folder: pathlib.Path, args: Any, rows: list[Comparison]) -> list[str]:
    """pays.md and pays.json; returns the lines of the table and the count."""
    about = {
        "presets": list(args.presets),
        "steps": args.steps,
        "seeds": args.seeds,
        "max_side": args.max_side,
        "set": list(args.set),
        **clock.machine(),
    }
    clock.write_metrics(folder / "pays.json", metrics_of(rows), about)
    verdicts = [verdict(row) for row in rows]
    counts = [f"{verdicts.count(one)} {one}" for one in dict.fromkeys(verdicts)]
    lines = [*table(rows), "", f"{len(rows)} pairs: {'; '.join(counts)}."]
    with replaced_file(folder / "pays.md") as partial:
        partial.write_text("\n".join(lines) + "\n")
    return lines
