"""Name, unit, better direction and explanation of the metrics in `metrics.json`."""

from collections.abc import Mapping
from typing import NamedTuple

from nerfies_jax.metrics.clock import Metric

GROUPS = ("Quality", "Geometry", "Motion", "Time", "Memory", "Size")


class Entry(NamedTuple):
    """Name, group, unit, direction and explanation of a metric."""

    name: str
    group: str  # one of GROUPS
    unit: str  # "dB", "ms", "bytes", or "" for a share or a count
    direction: str  # better values: "higher", "lower", or "equal" for neither
    explanation: str  # one sentence


# Metrics of held-out frames without fitted codes, and those that replace them as the
# main result of a model with per-frame codes.
FITTED = {
    "heldout.psnr": "heldout.fitted_psnr",
    "heldout.ssim": "heldout.fitted_ssim",
}
PROTOCOL = (
    "NeRF-W's protocol: codes fitted to the left half of each frame, scored on the "
    "right half"
)


def main_key(key: str, values: Mapping[str, object]) -> str:
    """Return the key of the main result in place of `key`.

    Args:
      key: A key of `METRICS`.
      values: The metrics of a run by key.

    Returns:
      The key of the metric with fitted codes, if the run has it. `key` otherwise.
    """
    fitted_key = FITTED.get(key, key)
    return fitted_key if values.get(fitted_key) is not None else key


METRICS: dict[str, Entry] = {
    "heldout.psnr": Entry(
        *("PSNR", "Quality", "dB", "higher"),
        "Mean peak signal-to-noise ratio between the rendered and the observed 8-bit "
        "images, over the held-out frames.",
    ),
    "heldout.ssim": Entry(
        *("SSIM", "Quality", "", "higher"),
        "Mean structural similarity over the held-out frames. It is 1 for identical "
        "images.",
    ),
    "heldout.ms_ssim": Entry(
        *("MS-SSIM", "Quality", "", "higher"),
        "Mean multi-scale structural similarity over the held-out frames. It is 1 for "
        "identical images.",
    ),
    "heldout.lpips": Entry(
        *("LPIPS", "Quality", "", "lower"),
        "Mean perceptual distance between network features of the rendered and the "
        "observed images, over the held-out frames.",
    ),
    "heldout.moving_psnr": Entry(
        *("PSNR, dynamic regions", "Quality", "dB", "higher"),
        "PSNR over the pixels of moving objects.",
    ),
    "heldout.moving_ssim": Entry(
        *("SSIM, dynamic regions", "Quality", "", "higher"),
        "SSIM over the pixels of moving objects.",
    ),
    "heldout.static_psnr": Entry(
        *("PSNR, static regions", "Quality", "dB", "higher"),
        "PSNR over the pixels of the static part of the scene.",
    ),
    "heldout.fitted_psnr": Entry(
        *("PSNR, NeRF-W protocol", "Quality", "dB", "higher"),
        "PSNR of the right halves of held-out frames, with appearance code or exposure "
        "fitted to the left halves. It is the main result of models that have them.",
    ),
    "heldout.fitted_ssim": Entry(
        *("SSIM, NeRF-W protocol", "Quality", "", "higher"),
        "SSIM of the right halves of held-out frames, with appearance code or exposure "
        "fitted to the left halves.",
    ),
    "heldout.camera_fitted_psnr": Entry(
        *("PSNR, fitted cameras", "Quality", "dB", "higher"),
        "PSNR of held-out frames whose cameras were optimized for the observed images.",
    ),
    "transient.share": Entry(
        *("Share of transients", "Quality", "", "equal"),
        "Mean opacity of the transient medium in training pixels at the end of "
        "training. A static scene that it swallows makes it large.",
    ),
    "heldout.frames": Entry(
        *("Frames scored", "Quality", "", "equal"),
        "Number of held-out frames that the metrics are computed on.",
    ),
    "heldout.unscored": Entry(
        *("Pixels not scored", "Quality", "", "lower"),
        "Share of the held-out pixels that are not valid, or that the model cannot "
        "render.",
    ),
    "heldout.depth_abs_rel": Entry(
        *("Relative depth error", "Geometry", "", "lower"),
        "Mean absolute error of the rendered depth, divided by the true depth.",
    ),
    "heldout.depth_within_delta": Entry(
        *("Depth accuracy", "Geometry", "", "higher"),
        "Share of the pixels whose rendered depth is within a factor of 1.25 of the "
        "true depth.",
    ),
    "heldout.depth_median": Entry(
        *("Median depth error", "Geometry", "scene units", "lower"),
        "Median absolute error of the rendered z-depth.",
    ),
    "heldout.depth_rmse": Entry(
        *("RMS depth error", "Geometry", "scene units", "lower"),
        "Root mean square error of the rendered z-depth.",
    ),
    "heldout.moving_depth_median": Entry(
        *("Median depth error, dynamic regions", "Geometry", "scene units", "lower"),
        "Median depth error over the pixels of moving objects.",
    ),
    "heldout.moving_depth_rmse": Entry(
        *("RMS depth error, dynamic regions", "Geometry", "scene units", "lower"),
        "RMS depth error over the pixels of moving objects.",
    ),
    "cameras.ate": Entry(
        *("Camera position error", "Geometry", "scene units", "lower"),
        "Root mean square error of the fitted camera positions after rigid alignment.",
    ),
    "cameras.rotation_error": Entry(
        *("Camera rotation error", "Geometry", "deg", "lower"),
        "Mean error of the relative rotation between consecutive fitted cameras.",
    ),
    "baseline.neighbor_mean": Entry(
        *("Baseline: mean of two neighbors", "Motion", "dB", "equal"),
        "PSNR of the mean of the two training frames nearest in time. A model that "
        "scores less has learned little.",
    ),
    "baseline.static": Entry(
        *("Baseline: static scene", "Motion", "dB", "higher"),
        "PSNR of renders of the model averaged over time, which show no motion.",
    ),
    "motion.gain": Entry(
        *("Gain from motion", "Motion", "dB", "higher"),
        "PSNR of the held-out frames minus that of the static baseline.",
    ),
    "motion.moving_gain": Entry(
        *("Gain from motion, dynamic regions", "Motion", "dB", "higher"),
        "Gain from motion over the pixels of moving objects.",
    ),
    "flow.epe": Entry(
        *("Optical flow error", "Motion", "px", "lower"),
        "Mean end-point error of the rendered optical flow to the next frame.",
    ),
    "flow.moving_epe": Entry(
        *("Optical flow error, dynamic regions", "Motion", "px", "lower"),
        "Optical flow error over the pixels of moving objects.",
    ),
    "flow.outliers": Entry(
        *("Optical flow outliers", "Motion", "", "lower"),
        "Share of the pixels whose flow error exceeds 3 px and 5 % of the true length.",
    ),
    "flow.missing": Entry(
        *("Optical flow missing", "Motion", "", "lower"),
        "Share of the pixels for which the model predicts no flow.",
    ),
    "tracks.epe": Entry(
        *("3D track error", "Motion", "scene units", "lower"),
        "Mean distance of tracked points from their true positions.",
    ),
    "tracks.static_epe": Entry(
        *("Baseline: static 3D tracks", "Motion", "scene units", "equal"),
        "3D track error of the prediction that no point moves.",
    ),
    "tracks.correct": Entry(
        *("3D track accuracy", "Motion", "", "higher"),
        "Share of the tracked points within 0.01 scene units of their true positions.",
    ),
    "tracks.lost": Entry(
        *("3D tracks lost", "Motion", "", "lower"),
        "Share of the points that the motion of the model does not determine.",
    ),
    "tracks.drift": Entry(
        *("Drift of static points", "Motion", "scene units", "lower"),
        "Mean distance that points of the static scene move over time.",
    ),
    "tracks.strain": Entry(
        *("Strain of the deformation", "Motion", "", "lower"),
        "Root mean square of the log singular values of the Jacobian of the "
        "deformation. It is 0 for a rigid motion.",
    ),
    "train.seconds": Entry(
        *("Training", "Time", "s", "lower"),
        "Wall-clock time of all training steps, without compilation.",
    ),
    "train.cpu_seconds": Entry(
        *("Training, processor", "Time", "s", "lower"),
        "Processor time of all training steps on all cores, without compilation. It "
        "depends less than the wall-clock time on what else the machine does.",
    ),
    "train.compile_seconds": Entry(
        *("Compilation", "Time", "s", "lower"),
        "Wall-clock time of compiling the training programs.",
    ),
    "train.steps": Entry(
        *("Steps", "Time", "", "equal"),
        "Completed training steps.",
    ),
    "render.ms_per_frame": Entry(
        *("Rendering a frame", "Time", "ms", "lower"),
        "Median wall-clock time of rendering a held-out frame at the size of the "
        "capture.",
    ),
    "render.fps": Entry(
        *("Rendering speed", "Time", "frames/s", "higher"),
        "Held-out frames rendered per second.",
    ),
    "total.seconds": Entry(
        *("Whole run", "Time", "s", "lower"),
        "Wall-clock time from reading the capture to this report.",
    ),
    "memory.peak_bytes": Entry(
        *("Peak memory", "Memory", "bytes", "lower"),
        "Largest resident memory of the process.",
    ),
    "memory.device_peak_bytes": Entry(
        *("Peak device memory", "Memory", "bytes", "lower"),
        "Largest memory in use on the first accelerator.",
    ),
    "gaussians": Entry(
        *("Gaussians", "Size", "", "lower"),
        "Active Gaussians that are rendered.",
    ),
    "rows": Entry(
        *("Anchors", "Size", "", "lower"),
        "Active anchors, each with several child Gaussians.",
    ),
    "parameters": Entry(
        *("Parameters", "Size", "", "lower"),
        "Number of trained parameters of the model.",
    ),
    "file.bytes": Entry(
        *("Model file", "Size", "bytes", "lower"),
        "Size of model.npz, which contains the complete model.",
    ),
}


def metric(key: str, value: float | int, tolerance: float = 0.0) -> Metric:
    """Create a metric with the unit and direction of the table.

    Args:
      key: A key of `METRICS`.
      value: The measured value, in the unit of the table.
      tolerance: Accepted decline of a later value, in the same unit.

    Returns:
      The metric.

    Raises:
      ValueError: If the table has no such key.
    """
    if key not in METRICS:
        raise ValueError(f"metric {key}: not in metric_table.METRICS; add it there")
    entry = METRICS[key]
    return Metric(key, value, entry.unit, entry.direction, tolerance)
