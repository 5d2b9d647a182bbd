"""The page of `experiments.speed` in docs/results."""

from collections.abc import Mapping
from typing import Any

from experiments import markdown

READING = """\
One training step of each preset on the built-in scene (176x132), the mean over the
phases of a run from its initial state. A step of splats renders `batch_size` views and
one of a field `rays` rays, so steps of different presets are not comparable. *One core*
is a process that sees one core, and *all* one that distributes a step over the cores
that its preset can use. *Compile* is the training program alone, without a cache.
*Frame* is one image on one core. *Peak* is all memory of the one-core process,
including JAX and the capture."""


PARTS = """\
Milliseconds on one core, each part by itself on the initial state. The motion of
presets that warm up (`splats-deformable-small`, `sonata-small`, `moba-small`) is
inactive there: its cost is in the step above, and in [effect_cost.md](effect_cost.md).
Parts may exceed the step, because parts of fields are measured with all rays at
once."""


def page(results: Mapping[str, Any]) -> str:
    """Format the tables of presets, the default command and the rasterizer.

    Args:
      results: The stored results.

    Returns:
      Markdown.
    """
    parts = [READING, _presets(results["presets"]), "## Where a step's time goes"]
    parts.append(PARTS)
    parts.append(_parts(results["presets"]))
    if "job" in results:
        parts += ["## The default command", _job(results["job"])]
        if "jobs" in results:
            jobs = (results["jobs"][name] for name in ("first", "beside", "again"))
            parts.append(_comparison(*jobs))
    if "raster" in results:
        parts += ["## The rasterizer compared with a tuned C++ one", RASTER]
        parts.append(_raster(results["raster"]["rows"]))
    return "\n\n".join(parts)


def _presets(presets):
    heads = ("preset", "one core, ms a step", "all, ms a step", "times as fast")
    heads += ("compile s", "frame ms", "peak MB")
    rows = []
    for name, record in presets.items():
        one, all_presets = record["one"], record["all"]
        rows.append(
            [
                f"`{name}`",
                markdown.number(one["step_ms"], 1),
                markdown.number(all_presets["step_ms"], 1),
                markdown.number(one["step_ms"] / all_presets["step_ms"], 2),
                markdown.number(one["compile_seconds"], 1),
                markdown.number(one["frame_ms"], 0),
                markdown.number(one["peak_mb"], 0),
            ]
        )
    return markdown.table(heads, rows)


def _parts(presets):
    """Format one row per preset, whose parts have different names."""
    rows = []
    for name, record in presets.items():
        parts = sorted(record["one"]["parts"].items(), key=lambda part: -part[1])
        text = [f"{part} {markdown.number(ms, 1)}" for part, ms in parts]
        rows.append([f"`{name}`", ", ".join(text)])
    return markdown.table(("preset", "ms"), rows, words=2)


def _job(job):
    return (
        f"The README's first command on {job['cpu']}, with nothing kept from before: "
        f"{job['seconds']:.0f} s from the command to its report, of which training "
        f"{job['train.seconds']:.0f} s and compiling it "
        f"{job['train.compile_seconds']:.0f} s; {job['heldout.psnr']:.2f} dB held out, "
        f"{job['heldout.moving_psnr']:.2f} dB for moving objects."
    )


def _comparison(first, second, again):
    """An earlier revision's job, between two of ours."""
    ours = (first["seconds"] + again["seconds"]) / 2
    heads = ("revision", "all s", "training s", "compiling it s", "PSNR", "moving PSNR")
    names = ("seconds", "train.seconds", "train.compile_seconds")
    rows = []
    for job in (first, second, again):
        quality = (job["heldout.psnr"], job["heldout.moving_psnr"])
        rows.append(
            [
                f"`{job['revision'][:7]}`",
                *(markdown.number(job[name], 0) for name in names),
                *(markdown.number(value, 2) for value in quality),
            ]
        )
    share = ours / second["seconds"]
    return (
        f"An earlier revision on {first['cpu']}, in one session: {ours:.0f} s, "
        f"the mean of both, for {second['seconds']:.0f} s, {share:.2f} of the time.\n\n"
        + markdown.table(heads, rows)
    )


RASTER = """\
Forward and backward, CPU milliseconds on one core, in one sitting: the other rasterizer
before and after ours, the mean of both."""


def _raster(rows):
    heads = ("case", "ours", "theirs", "times as long")
    names = ("forward_backward_ms", "reference_forward_backward_ms")
    return markdown.table(
        heads,
        [
            [
                row["case"],
                *(markdown.number(row.get(name), 1) for name in names),
                markdown.number(row.get("ratio"), 2),
            ]
            for row in rows
        ],
    )
