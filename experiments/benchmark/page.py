"""The page of `experiments.benchmark` in docs/results."""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from experiments import markdown

COLUMNS = (
    ("PSNR", "heldout.psnr", 2),
    ("SSIM", "heldout.ssim", 3),
    ("moving", "heldout.moving_psnr", 2),
    ("still", "heldout.static_psnr", 2),
    ("neighbors", "baseline.neighbor_mean", 2),
    ("time average", "baseline.static", 2),
    ("EPE", "tracks.epe", 4),
    ("EPE at rest", "tracks.static_epe", 4),
    ("flow px", "flow.epe", 2),
    ("moving flow px", "flow.moving_epe", 2),
    ("training s", "train.seconds", 0),
    ("all s", "total.seconds", 0),
)
READING = """\
PSNR (dB) and SSIM of held-out pictures as they were filmed; *moving* and *still* are
the PSNR of pixels that move by themselves and of the others. *neighbors* is the PSNR
of the mean of the two training pictures before and after, *time average* that of the
run's own renders averaged over time: a run that does not stand above both did nothing.
*EPE* is how far points that are followed are from where they truly are, in scene units,
*EPE at rest* the same if none of them moved; *flow* is the end-point error of where
pixels go until the camera's next frame, in pixels, of all and of those that move by
themselves. Each number is the median over seeds, with the least and the largest in
brackets. Seconds are wall clock, and whatever else the machine did is in them:
*training* without compiling, *all* from the command to the report, with what the
pictures say before training where it was not kept yet."""


def page(stored: Mapping[str, Any]) -> str:
    """The tables: one row for what was run, over its seeds."""
    heads = ("run", "preset", "seeds", *(head for head, _, _ in COLUMNS))
    runs = stored["runs"].items()
    rows = [_row(label, list(seeds.values())) for label, seeds in runs]
    return f"{READING}\n\n{markdown.table(heads, rows, words=2)}"


def _row(label: str, scored: Sequence[Mapping[str, Any]]) -> list[str]:
    presets = " / ".join(sorted({one["preset"] for one in scored}))
    cells = [f"`{label}`", presets, str(len(scored))]
    for _, key, digits in COLUMNS:
        values = sorted(one["metrics"][key] for one in scored if key in one["metrics"])
        cells.append(_spread([v for v in values if math.isfinite(v)], digits))
    return cells


def _spread(values, digits):
    """The median, and the ends where there are several."""
    if not values:
        return ""
    middle = markdown.number(statistics.median(values), digits)
    if len(values) == 1:
        return middle
    ends = " to ".join(markdown.number(values[k], digits) for k in (0, -1))
    return f"{middle} ({ends})"
