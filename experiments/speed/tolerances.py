"""Measurements of speed.json that a later file is compared with, and tolerances."""

from collections.abc import Iterator, Mapping
from typing import Any

from nerfies_jax.metrics.clock import Metric

# Shares of a value; quiet machines of one kind repeat times to a tenth.
TIMES, COMPILING, MEMORY, RATIO = 0.25, 0.5, 0.1, 0.15
OF_PRESETS = {
    "step_ms": ("ms", TIMES),
    "frame_ms": ("ms", TIMES),
    "compile_seconds": ("s", COMPILING),
    "peak_mb": ("MB", MEMORY),
}
DECIBELS = {"heldout.psnr": 0.5, "heldout.moving_psnr": 1.0}  # four deviations


def metrics(results: Mapping[str, Any]) -> list[Metric]:
    """Collect step times of presets, ratios of the rasterizer, and the main job."""
    return [*_presets(results.get("presets", {})), *_raster(results), *_job(results)]


def _within(key, value, unit, share) -> Metric:
    return Metric(key, value, unit, "lower", share * value)


def _presets(presets) -> Iterator[Metric]:
    for preset, cores in presets.items():
        for which, record in cores.items():
            for name, (unit, share) in OF_PRESETS.items():
                if name in record:
                    yield _within(f"{preset}.{which}.{name}", record[name], unit, share)


def _raster(results) -> Iterator[Metric]:
    for row in results.get("raster", {}).get("rows", ()):
        if "ratio" in row:
            yield _within(f"raster.{row['case']}.ratio", row["ratio"], "", RATIO)


def _job(results) -> Iterator[Metric]:
    if "job" not in results:
        return
    job = results["job"]
    yield _within("job.seconds", job["seconds"], "s", TIMES)
    for name, tolerance in DECIBELS.items():
        if job.get(name) is not None:  # where nothing moves
            yield Metric(f"job.{name}", job[name], "dB", "higher", tolerance)
