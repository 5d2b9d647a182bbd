"""The page of `experiments.on_device` in docs/results."""

from collections.abc import Mapping
from typing import Any

from experiments import markdown

RASTER = """\
Medians of wall-clock time for Gaussians of about 6.5 pixels, without projection. The
gradient is that of the means, shapes, opacities and colors. *Peak* is device memory."""
STEPS = """\
The mean of a training step over the phases of a run on the built-in scene (176x132),
from its initial state. *Compile* is the training program, without a cache."""


def page(results: Mapping[str, Any]) -> str:
    """Format the results of all parts that were run.

    Args:
      results: The stored results.

    Returns:
      Markdown.
    """
    machine = results.get("machine", {})
    device = machine.get("device", "unknown")
    parts = [f"The device is **{device}** ({machine.get('backend', 'unknown')})."]
    for part, write in SECTIONS.items():
        if part in results:
            good = {k: x for k, x in results[part].items() if not x["failure"]}
            bad = {k: x for k, x in results[part].items() if x["failure"]}
            parts += write(good) if good else [f"## {TITLES[part]}"]
            lines = [
                f"{k} failed: {' '.join(x['failure'].split())}" for k, x in bad.items()
            ]
            parts += [markdown.bullets(lines)] if bad else []
    return "\n\n".join(parts)


TITLES = {
    "raster": "The rasterizer",
    "steps": "Training steps",
    "job": "The default command",
    "tests": "The core tests",
}


def _raster(rows):
    heads = ("Gaussians@image", "forward ms", "forward and backward ms", "peak MB")
    names = ("forward_ms", "forward_backward_ms", "device_peak_mb")
    return _format_table("raster", RASTER, heads, names, rows)


def _steps(rows):
    heads = ("preset", "step ms", "compile s", "devices", "peak MB")
    names = ("step_ms", "compile_seconds", "devices", "device_peak_mb")
    return _format_table("steps", STEPS, heads, names, rows)


def _format_table(part, text, heads, names, rows):
    cells = [
        [f"`{key}`", *(markdown.short(row.get(name)) for name in names)]
        for key, row in rows.items()
    ]
    return [f"## {TITLES[part]}", text, markdown.table(heads, cells)]


def _job(rows):
    job = rows["default"]
    cells = {
        "seconds": markdown.number(job["seconds"], 0),
        "of which training": markdown.number(job["train.seconds"], 0),
        "and compiling it": markdown.number(job["train.compile_seconds"], 0),
        "held-out PSNR": markdown.number(job["heldout.psnr"], 2),
    }
    table = markdown.table([*cells], [[*cells.values()]], words=0)
    return [f"## {TITLES['job']}", "From empty caches to its report.", table]


def _tests(rows):
    parts = [f"## {TITLES['tests']}"]
    for name, counts in rows.items():
        numbers = (f"{counts[x]:,} {x}" for x in ("passed", "failed", "skipped"))
        seconds = markdown.number(counts["seconds"], 0)
        parts.append(f"`pytest {name}`: {', '.join(numbers)}, in {seconds} s.")
        if counts["failed_tests"]:
            parts.append(markdown.bullets(f"`{x}`" for x in counts["failed_tests"]))
    return parts


SECTIONS = {"raster": _raster, "steps": _steps, "job": _job, "tests": _tests}
