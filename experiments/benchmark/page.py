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
    ("static", "heldout.static_psnr", 2),
    ("neighbors", "baseline.neighbor_mean", 2),
    ("time average", "baseline.static", 2),
    ("EPE", "tracks.epe", 4),
    ("static EPE", "tracks.static_epe", 4),
    ("flow px", "flow.epe", 2),
    ("moving flow px", "flow.moving_epe", 2),
    ("training s", "train.seconds", 0),
    ("all s", "total.seconds", 0),
)
READING = """\
PSNR (dB) and SSIM are of the original, distorted held-out images. *moving* and *static*
are the PSNR of moving objects and of the static background. *neighbors* is the PSNR of
the mean of the two neighboring training images, and *time average* that of the run's
own renders averaged over time. A run must exceed both of these baselines. *EPE* is the
mean distance of tracked points from their true positions in scene units, and *static
EPE* that of a prediction without motion. *flow* is the end-point error of optical flow
to the camera's next frame in pixels, over all pixels and over moving objects. Each
number is the median over seeds, with minimum and maximum in brackets. Seconds are wall
clock, on a machine that may do other work: *training* excludes compilation, and *all*
is from the command to the report, including preprocessing that was not cached."""


def page(stored: Mapping[str, Any]) -> str:
    """Format one row for each capture, over its seeds.

    Args:
      stored: The stored results.

    Returns:
      Markdown.
    """
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
    """Format the median, and minimum and maximum if there are several."""
    if not values:
        return ""
    middle = markdown.number(statistics.median(values), digits)
    if len(values) == 1:
        return middle
    ends = " to ".join(markdown.number(values[k], digits) for k in (0, -1))
    return f"{middle} ({ends})"
