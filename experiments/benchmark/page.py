"""Pages of `experiments.benchmark` in docs/results."""

from collections.abc import Iterable, Mapping
from typing import Any

from experiments import markdown
from experiments.benchmark import curves, origin, suites
from nerfies_jax.metrics.metric_table import METRICS

# Of `origin.age`, in the tables.
AGES = {"current": "today's", "old": "**old**", "unknown": "not stored"}
# Columns: key of metrics.json, heading, digits behind the point, divisor.
Column = tuple[str, str, int, float]
GROUPS: tuple[tuple[Column, ...], ...] = (
    (
        ("heldout.psnr", "PSNR", 2, 1),
        ("heldout.fitted_psnr", "fitted PSNR", 2, 1),
        ("heldout.ssim", "SSIM", 3, 1),
        ("heldout.lpips", "LPIPS", 3, 1),
        ("heldout.moving_psnr", "moving PSNR", 2, 1),
        ("heldout.moving_ssim", "moving SSIM", 3, 1),
        ("heldout.static_psnr", "static PSNR", 2, 1),
        ("baseline.neighbor_mean", "neighbors", 2, 1),
        ("baseline.static", "time average", 2, 1),
    ),
    (
        ("tracks.epe", "EPE", 4, 1),
        ("tracks.static_epe", "static EPE", 4, 1),
        ("tracks.correct", "<0.01", 2, 1),
        ("tracks.lost", "lost", 3, 1),
        ("tracks.drift", "drift", 4, 1),
        ("tracks.strain", "strain", 2, 1),
        ("flow.epe", "flow", 2, 1),
        ("flow.moving_epe", "moving flow", 2, 1),
        ("heldout.depth_median", "depth", 4, 1),
        ("heldout.moving_depth_median", "moving depth", 4, 1),
    ),
    (
        ("train.steps", "steps", 0, 1),
        ("train.seconds", "training s", 0, 1),
        ("train.cpu_seconds", "training CPU s", 0, 1),
        ("train.compile_seconds", "compilation s", 0, 1),
        ("total.seconds", "all s", 0, 1),
        ("render.ms_per_frame", "frame ms", 0, 1),
        ("gaussians", "Gaussians", 0, 1),
        ("parameters", "parameters", 0, 1),
        ("file.bytes", "file MB", 2, 1e6),
        ("memory.peak_bytes", "peak MB", 0, 1e6),
    ),
)
READING = """\
Numbers are means over the seeds, ± their standard deviation. Scores are of the
original, distorted held-out images. The *fitted PSNR* is NeRF-W's protocol: codes of
each image are fitted to its left half, and its right half is evaluated. A run must
exceed both baselines (*neighbors*, *time average*). Seconds are wall clock, on a
machine that may have been busy. *CPU s* is processor time on all cores. The *settings*
say if the preset has the same settings today as in the runs. They are *not stored* in
rows of earlier versions, and rows of *old* settings no longer describe the preset of
that name. The *revision* is that of this repository when the runs
ended. A + marks changes that were not committed, or that only the revision before the
numbers were committed is known."""


def page(results: Mapping[str, Any]) -> str:
    """Format the tables below the docstring.

    Args:
      results: The stored results.

    Returns:
      Markdown.
    """
    single, parts = {}, [READING]
    for label, benchmark in results["benchmarks"].items():
        if benchmark["suite"] is None:
            (single[label],) = _methods(benchmark).values()
        else:
            parts += _suite(label, benchmark)
    if single:
        parts += _tables("run", single)
    methods = [
        method
        for benchmark in results["benchmarks"].values()
        for method in benchmark["methods"].values()
    ]
    return "\n\n".join([*parts, markdown.bullets(_legend(methods))])


def _methods(benchmark):
    """Return the methods of a benchmark by name, each with its revision."""
    common = {"revision": benchmark["revision"]}
    return {name: common | one for name, one in benchmark["methods"].items()}


def _suite(label, benchmark):
    suite = suites.SUITES[benchmark["suite"]]
    parts = [f"## `{label}`"]
    if suite.steps:
        parts.append(curves.table(benchmark))
    parts += _tables("method", _methods(benchmark))
    if benchmark["claims"]:
        parts += ["### Claims", _claims(benchmark["claims"])]
    return [*parts, suite.context] if suite.context else parts


def _tables(kind, methods):
    """Format the settings of each row, and one table for each group of columns."""
    rows = [
        [
            f"`{name}`",
            one["settings"],
            AGES[origin.age(one.get("made_with"))],
            str(one["seeds"]),
            _short(one["revision"]),
        ]
        for name, one in methods.items()
    ]
    heads: tuple[str, ...] = (kind, "preset and changes", "settings")
    heads += ("seeds", "revision")
    tables = [markdown.table(heads, rows, words=3)]
    for group in GROUPS:
        columns = _measured_columns(group, methods.values())
        heads = (kind, *(column[1] for column in columns))
        rows = [
            [f"`{name}`", *(_cell(one, column) for column in columns)]
            for name, one in methods.items()
        ]
        if columns:
            tables.append(markdown.table(heads, rows))
    return tables


def _short(revision):
    """Format a revision by its first eight digits, and a mark for changed files."""
    commit, _, changes = revision.partition("+")
    return commit[:8] + ("+" if changes else "")


def _measured_columns(group: Iterable[Column], methods) -> list[Column]:
    return [column for column in group if any(column[0] in m["mean"] for m in methods)]


def _cell(method, column):
    key, _, digits, divisor = column
    if key not in method["mean"]:
        return ""
    spread = method["spread"].get(key, float("nan")) / divisor
    return markdown.with_spread(method["mean"][key] / divisor, spread, digits)


def _claims(verdicts):
    rows = []
    for one in verdicts:
        gain = markdown.short(one["gain"])
        if one["half_width"] is not None:
            gain += f" ± {markdown.short(one['half_width'])}"
        claim = f"{one['claim']}: `{one['better']}` compared with `{one['worse']}`"
        rows.append([claim, f"`{one['metric']}`", gain, one["verdict"]])
    return markdown.table(("claim", "metric", "gain", "verdict"), rows, words=4) + (
        "\n\nA positive gain supports the claim, and ± is its 95 % confidence interval "
        "(Student, seeds paired)."
    )


def _legend(methods):
    for group in GROUPS:
        for key, heading, *_ in _measured_columns(group, methods):
            entry = METRICS[key]
            unit = "" if heading.endswith(("MB", " s", " ms")) else entry.unit
            yield f"{heading}{f' ({unit})' if unit else ''}: {entry.explanation}"
