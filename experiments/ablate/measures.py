"""Measures of every run of an ablation, without JAX."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple


class Measure(NamedTuple):
    """One number of a trained arm."""

    heading: str  # in the table
    unit: str
    direction: str  # which is better: "lower" or "higher"; "equal" for neither
    tolerance: float  # how much worse a later run may be, in the unit
    digits: int  # behind the point
    share: float = 0.0  # or so much of its value, whichever is more

    def allowed(self, value: float) -> float:
        """Tolerated deterioration of a value, zero if it is unknown."""
        return max(self.tolerance, self.share * value) if value == value else 0.0


MEASURES = {
    "psnr": Measure("PSNR", "dB", "higher", 0.5, 2),
    "ssim": Measure("SSIM", "", "higher", 0.02, 3),
    "moving_psnr": Measure("moving", "dB", "higher", 0.5, 2),
    "moving_ssim": Measure("SSIM", "", "higher", 0.03, 3),
    "depth_median": Measure("depth", "scene units", "lower", 0.002, 4),
    "depth_rmse": Measure("RMSE", "scene units", "lower", 0.01, 4),
    "moving_depth_median": Measure("moving", "scene units", "lower", 0.005, 4),
    "moving_depth_rmse": Measure("RMSE", "scene units", "lower", 0.02, 4),
    "track_error": Measure("EPE", "scene units", "lower", 0.003, 4),
    "track_correct": Measure("<0.01", "", "higher", 0.05, 2),
    "track_lost": Measure("lost", "", "lower", 0.02, 3),
    "drift": Measure("drift", "scene units", "lower", 0.002, 4),
    "strain": Measure("strain", "", "lower", 0.1, 2),
    "gaussians": Measure("Gauss.", "", "equal", 200.0, 0, 0.1),
    "parameters": Measure("params", "", "equal", 0.0, 0, 0.1),
    "steps": Measure("steps", "", "equal", 0.0, 0, 0.1),
    "train_seconds": Measure("train s", "s", "lower", 2.0, 0, 0.33),
    "train_cpu_seconds": Measure("CPU s", "s", "lower", 2.0, 0, 0.33),
    "compile_seconds": Measure("compile", "s", "lower", 5.0, 1, 0.33),
    "render_ms": Measure("frame ms", "ms", "lower", 10.0, 0, 0.33),
    "peak_mb": Measure("peak MB", "MB", "lower", 100.0, 0, 0.2),
    "model_mb": Measure("model MB", "MB", "lower", 0.1, 2, 0.1),
    "coded_mb": Measure("coded MB", "MB", "lower", 0.05, 3, 0.1),
}

COSTS = tuple(MEASURES)[tuple(MEASURES).index("gaussians") :]  # the others are quality

# What `nerfies_jax.evaluation.heldout` calls the measures of quality.
KEYS = {
    "psnr": "heldout.psnr",
    "ssim": "heldout.ssim",
    "moving_psnr": "heldout.moving_psnr",
    "moving_ssim": "heldout.moving_ssim",
    "depth_median": "heldout.depth_median",
    "depth_rmse": "heldout.depth_rmse",
    "moving_depth_median": "heldout.moving_depth_median",
    "moving_depth_rmse": "heldout.moving_depth_rmse",
    "track_error": "tracks.epe",
    "track_correct": "tracks.correct",
    "track_lost": "tracks.lost",
    "drift": "tracks.drift",
    "strain": "tracks.strain",
}
DEPTHS = tuple(name for name in KEYS if "depth" in name)


def quality(scores: Mapping[str, float], exact: bool) -> dict[str, float]:
    """Compute the quality measures of a run.

    Args:
      scores: Metrics by key.
      exact: Whether depths and masks are ground truth. Estimated depths judge nothing.
        Estimated masks only select the regions in which all methods are compared.

    Returns:
      Measures by name, NaN where unknown.
    """
    numbers = {name: scores.get(key, float("nan")) for name, key in KEYS.items()}
    if not exact:
        numbers |= dict.fromkeys(DEPTHS, float("nan"))
    return numbers


# One line and more for the columns of a group; a group is explained where it is shown.
LEGENDS = {
    "psnr": "PSNR, SSIM: mean over the 8-bit images of held-out frames. SSIM is\n"
    "scikit-image's Gaussian form (sigma 1.5).",
    "moving_psnr": "moving: the same two for moving objects, by the capture's masks "
    "or else by tracks.",
    "depth_median": "depth, RMSE: median and root mean square of the error, scene "
    "units; then of moving pixels.",
    "track_error": "EPE: mean distance of points tracked from the middle frame time to "
    "their true positions;\n<0.01: share nearer than that; lost: share that was not "
    "found and counts as static.\nstill: the EPE of a static prediction.",
    "drift": "drift: displacement of static points.",
    "strain": "strain: ||log S|| of the warp's Jacobian (root mean square).",
    "gaussians": "Gauss.: active Gaussians at the end.",
    "parameters": "params: trained numbers, 4 bytes each.",
    "train_seconds": "train s: training time without compilation; CPU s: the same over "
    "all threads;\ncompile: compilation of the step without a cache; frame ms: "
    "rendering a held-out frame (all\nthreads, on a CPU); peak MB: peak memory of the "
    "process, if it trained one method only.",
    "model_mb": "model MB: file of a trained scene; for a field its parameters, "
    "without the optimizer.",
    "coded_mb": "coded MB: the same scene with entropy-coded features, and 32 bits for "
    "all other numbers.",
}


def stored_means(
    metrics: Mapping[str, Mapping[str, Any]], spread: bool = False
) -> dict[str, dict[str, float]]:
    """Means over the seeds by arm and measure, of what `report.metrics` wrote down.

    Or, with `spread`, their standard deviations. NaN where a number is not known.
    """
    means: dict[str, dict[str, float]] = {}
    for key, row in metrics.items():
        if key.endswith(".spread") != spread:
            continue
        arm, _, name = key.removesuffix(".spread").rpartition(".")
        if name in MEASURES and arm != "still":
            value = math.nan if row["value"] is None else row["value"]
            means.setdefault(arm, dict.fromkeys(MEASURES, math.nan))[name] = value
    return means


def shown(numbers: Mapping[tuple[str, int], Mapping[str, float]]) -> list[str]:
    """The measures that any arm has a number for."""
    return [
        name
        for name in MEASURES
        if any(row[name] == row[name] for row in numbers.values())  # not NaN
    ]


def legend(names) -> str:
    """Explain the columns that are shown."""
    return "\n".join(text for name, text in LEGENDS.items() if name in names)
