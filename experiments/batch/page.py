"""Table and page of a batch."""

import html
import pathlib
from collections.abc import Mapping
from typing import Any

from experiments import markdown
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.metrics.metric_table import METRICS
from nerfies_jax.runs.report_style import STYLE

# Columns: key of metrics.json, heading, digits behind the point, divisor.
COLUMNS = (
    ("heldout.psnr", "PSNR", 2, 1),
    ("heldout.moving_psnr", "moving PSNR", 2, 1),
    ("heldout.ssim", "SSIM", 3, 1),
    ("baseline.neighbor_mean", "neighbors", 2, 1),
    ("train.seconds", "training s", 0, 1),
    ("total.seconds", "all s", 0, 1),
    ("memory.peak_bytes", "peak MB", 0, 1e6),
)
HEADS = ("capture", "preset", "seeds", *(column[1] for column in COLUMNS))
STYLE_OF_TABLE = "td, th { white-space: nowrap; } td img { width: 20rem; }"


def table(results: Mapping[str, Any]) -> str:
    """Format the results of a batch for a terminal.

    Args:
      results: The content of batch.json.

    Returns:
      A table in Markdown.
    """
    return markdown.table(HEADS, map(_cells, results["rows"]), words=2)


def write(path: pathlib.Path, results: Mapping[str, Any]) -> None:
    """Write the page of a batch, with links to the reports and logs of its runs.

    Args:
      path: The page, in the folder that the stored paths are relative to.
      results: The content of batch.json.
    """
    rows = "".join(map(_row, results["rows"]))
    heads = "".join(f'<th scope="col">{head}</th>' for head in (*HEADS, "reports", ""))
    failures = "".join(
        f"<li>{html.escape(each['run'])}: exit code {each['code']}, "
        f"{html.escape(each['reason'])} ({_link(each['log'], 'log')})</li>"
        for each in results["failures"]
    )
    legend = "".join(
        f"<li>{head}: {html.escape(METRICS[key].explanation)}</li>"
        for key, head, *_ in COLUMNS
    )
    title = f"{len(results['rows'])} reconstructions, {len(results['failures'])} failed"
    text = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>\n{STYLE}{STYLE_OF_TABLE}</style>\n</head>\n"
        f"<body>\n<main>\n<h1>{title}</h1>\n"
        + (f"<h2>Failed runs</h2>\n<ul>{failures}</ul>\n" if failures else "")
        + "<p>Numbers are means over the seeds, ± their standard deviation.</p>\n"
        f'<div class="wide"><table><thead><tr>{heads}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>\n<ul>{legend}</ul>\n"
        "</main>\n</body>\n</html>\n"
    )
    with replaced_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _cells(row):
    trained_presets = [] if row["trained"] in ([], [row["preset"]]) else row["trained"]
    preset = " ".join([row["preset"], *(f"({name})" for name in trained_presets)])
    return [row["capture"], preset, str(row["seeds"]), *map(_cell_of(row), COLUMNS)]


def _cell_of(row):
    def cell(column):
        key, _, digits, divisor = column
        if key not in row["mean"]:
            return ""
        spread = row["spread"].get(key, float("nan")) / divisor
        return markdown.with_spread(row["mean"][key] / divisor, spread, digits)

    return cell


def _row(row):
    cells = "".join(f"<td>{html.escape(cell)}</td>" for cell in _cells(row))
    links = ", ".join(
        _link(f"{run}/report.html", run.rpartition("-")[2]) for run in row["runs"]
    )
    image = ""
    if row["runs"]:
        source = html.escape(f"{row['runs'][0]}/comparison.png", quote=True)
        image = f'<img loading="lazy" alt="images of the first run" src="{source}">'
    return f"<tr>{cells}<td>{links}</td><td>{image}</td></tr>"


def _link(path, text):
    return f'<a href="{html.escape(path, quote=True)}">{html.escape(text)}</a>'
