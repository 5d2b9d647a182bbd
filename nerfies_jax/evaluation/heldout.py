"""All metrics of held-out frames, and a table of their keys."""

import functools
from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation import protocol
from nerfies_jax.evaluation.baseline_images import Baselines
from nerfies_jax.evaluation.fitted_cameras import FittedCameras
from nerfies_jax.evaluation.model_flow import Flow
from nerfies_jax.evaluation.protocol import GroundTruth, PointTracks
from nerfies_jax.evaluation.scores import Scored, known_mean
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.metrics import geometry_quality, image_quality, perceptual
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.metrics.metric_table import metric
from nerfies_jax.metrics.perceptual import LpipsParams, Network
from nerfies_jax.training.model import in_default_precision

# Five scales halve an image four times, and the last one must hold the window of 11.
MS_SSIM_SIDE = 160  # pixels that the shorter side must exceed


# Tolerated decline in a later run, in the units of `metric_table.METRICS`.
TOLERANCES = {
    "heldout.psnr": 0.2,
    "heldout.ssim": 0.01,
    "heldout.ms_ssim": 0.01,
    "heldout.lpips": 0.01,
    "heldout.moving_psnr": 0.3,
    "heldout.moving_ssim": 0.02,
    "heldout.static_psnr": 0.2,
    "heldout.unscored": 0.01,
    "baseline.neighbor_mean": 0.05,
    "baseline.static": 0.3,
    "motion.gain": 0.2,
    "motion.moving_gain": 0.3,
    "heldout.depth_abs_rel": 0.01,
    "heldout.depth_within_delta": 0.02,
    "heldout.depth_median": 0.002,
    "heldout.depth_rmse": 0.01,
    "heldout.moving_depth_median": 0.005,
    "heldout.moving_depth_rmse": 0.02,
    "heldout.camera_fitted_psnr": 0.2,
    "cameras.ate": 0.002,
    "cameras.rotation_error": 0.1,
    "flow.epe": 0.2,
    "flow.outliers": 0.02,
    "flow.missing": 0.02,
    "flow.moving_epe": 0.3,
    "tracks.epe": 0.003,
    "tracks.static_epe": 0.0,
    "tracks.correct": 0.05,
    "tracks.lost": 0.02,
    "tracks.drift": 0.002,
    "tracks.strain": 0.1,
}


class Lpips(NamedTuple):
    """A network for LPIPS and its trained weights."""

    network: Network
    params: LpipsParams


def heldout_metrics(
    scored: Scored,
    capture: Capture,
    *,
    lpips: Lpips | None = None,
    known: GroundTruth | None = None,
    followed: PointTracks | None = None,
    flow: Flow | None = None,
    fitted: FittedCameras | None = None,
    baselines: Baselines = Baselines(None, None),
) -> dict[str, float]:
    """Compute all metrics of held-out frames for which there is data.

    PSNR and SSIM are always computed. Others need data of the capture (masks of moving
    pixels, depths) or an argument. Metrics without any values to average are omitted.

    Args:
      scored: Rendered frames.
      capture: The capture.
      lpips: Weights of LPIPS, or None.
      known: Ground truth of point tracks, or None.
      followed: Predicted point tracks, or None.
      flow: Predicted and true optical flow, or None.
      fitted: Frames rendered with fitted cameras, or None.
      baselines: Baselines.

    Returns:
      Values by the keys of `TOLERANCES`.
    """
    scores = {
        "heldout.psnr": known_mean(scored.psnr),
        "heldout.ssim": known_mean(scored.ssim),
    }
    optional_scores = _image_metrics(scored, capture, lpips)
    if capture.valid is not None:
        optional_scores["heldout.unscored"] = 1 - capture.valid[scored.rows].mean()
    optional_scores |= _baselines(baselines, scored, capture)
    if capture.depths is not None:
        optional_scores |= _depths(scored, capture)
    if known is not None and followed is not None:
        optional_scores |= protocol.score_tracks(known, followed)
        optional_scores["tracks.static_epe"] = protocol.static_error(known)
    if flow is not None:
        optional_scores |= _flow(flow)
    if fitted is not None:
        optional_scores |= _cameras(fitted, capture, exact=known is not None)
    return scores | {
        key: float(x) for key, x in optional_scores.items() if not np.isnan(x)
    }


def metrics(numbers: Mapping[str, float]) -> list[Metric]:
    """Convert values to metrics with tolerances.

    Args:
      numbers: Values by the keys of `TOLERANCES`.

    Returns:
      Metrics in the order of `TOLERANCES`.
    """
    return [
        metric(key, numbers[key], tolerance)
        for key, tolerance in TOLERANCES.items()
        if key in numbers
    ]


def _image_metrics(renders, capture, lpips):
    """Compute means over frames of metrics over the valid, moving or static pixels."""
    values = {}
    for row, color in zip(renders.rows, renders.color, strict=True):
        valid = None if capture.valid is None else capture.valid[row]
        moving = None if capture.moving is None else capture.moving[row]
        scores = _score(color, capture.images[row], valid, moving)
        if lpips is not None:
            scores["heldout.lpips"] = _lpips(
                lpips.params, lpips.network, color, capture.images[row], valid
            )
        for key, value in jax.device_get(scores).items():
            values.setdefault(key, []).append(value)
    # Frames without moving or without static pixels are skipped.
    return {key: known_mean(np.asarray(each)) for key, each in values.items()}


def _baselines(baselines, renders, capture):
    """Compute the PSNR of the baselines, and the gain over static renders."""
    numbers = {}
    if baselines.neighbors is not None:
        psnr = _baseline_psnr(baselines.neighbors, renders, capture)
        numbers["baseline.neighbor_mean"] = known_mean(psnr[:, 0])
    if baselines.static is not None:
        psnr = _baseline_psnr(baselines.static, renders, capture)
        model = baselines.static._replace(color=renders.color[baselines.static.places])
        gain = _baseline_psnr(model, renders, capture) - psnr
        numbers["baseline.static"] = known_mean(psnr[:, 0])
        numbers["motion.gain"] = known_mean(gain[:, 0])
        numbers["motion.moving_gain"] = known_mean(gain[:, 1])
    return numbers


def _baseline_psnr(averages, renders, capture):
    """Compute the PSNR of all valid pixels and of the moving ones, [places, 2]."""
    psnrs = []
    for index, (place, color) in enumerate(
        zip(averages.places, averages.color, strict=True)
    ):
        row = renders.rows[place]
        mask = np.ones(color.shape[:2], bool)
        if capture.valid is not None:
            mask &= capture.valid[row]
        if averages.known is not None:
            mask &= averages.known[index]
        no_pixels = np.zeros_like(mask)
        moving = no_pixels if capture.moving is None else mask & capture.moving[row]
        psnrs.append(_masked_psnrs(color, capture.images[row], mask, moving))
    return np.asarray(jax.device_get(psnrs))


@jax.jit
def _masked_psnrs(color, truth, mask, moving):
    image = image_quality.quantize(color)
    truth = truth.astype(color.dtype) / 255
    return [image_quality.masked_psnr(image, truth, each) for each in (mask, moving)]


@jax.jit
def _score(color, truth, valid, moving):
    image = image_quality.quantize(color)
    truth = truth.astype(color.dtype) / 255
    numbers = {}
    if moving is not None:
        static = ~moving
        if valid is not None:
            moving, static = moving & valid, static & valid
        numbers["heldout.moving_psnr"] = image_quality.masked_psnr(image, truth, moving)
        numbers["heldout.moving_ssim"] = image_quality.masked_ssim(image, truth, moving)
        numbers["heldout.static_psnr"] = image_quality.masked_psnr(image, truth, static)
    if valid is None and min(image.shape[:2]) > MS_SSIM_SIDE:
        numbers["heldout.ms_ssim"] = image_quality.ms_ssim(image, truth)
    return numbers


@functools.partial(jax.jit, static_argnums=1)
def _lpips(params, network, color, truth, valid):
    image = image_quality.quantize(color)
    truth = truth.astype(color.dtype) / 255
    if valid is None:
        return perceptual.lpips(params, network, image, truth)
    return perceptual.masked_lpips(params, network, image, truth, valid)


# One program each, because their operations take longer to compile separately.
@jax.jit
def _depth_errors(depth, truth, mask):
    valid = geometry_quality.known_depth(depth, truth, mask)
    return valid, geometry_quality.depth_errors(depth, truth, mask)


_flow_errors = jax.jit(geometry_quality.flow_errors)


def _depths(renders, capture):
    """Compute depth errors over the known pixels of all frames together."""
    truth, depth = capture.depths[renders.rows], renders.depth
    masks = {"": None}
    if capture.moving is not None:
        masks["moving_"] = capture.moving[renders.rows]
    numbers = {}
    for name, mask in masks.items():
        valid, errors = _depth_errors(depth, truth, mask)
        error = np.abs(depth - truth)[np.asarray(valid)]
        numbers[f"heldout.{name}depth_median"] = known_mean(error, np.median)
        numbers[f"heldout.{name}depth_rmse"] = errors.rmse
        if mask is None:
            numbers["heldout.depth_abs_rel"] = errors.abs_rel
            numbers["heldout.depth_within_delta"] = errors.within_delta
    return numbers


def _flow(flow):
    """Compute end-point errors of pixels with a prediction. Others are outliers."""
    has_prediction = np.isfinite(flow.predicted).all(axis=-1)
    flows = in_default_precision((flow.predicted, flow.truth))

    def errors(mask=None):
        return _flow_errors(*flows, mask)

    numbers = {
        "flow.epe": errors(has_prediction).endpoint,
        "flow.outliers": errors().outliers,
        "flow.missing": 1 - has_prediction.mean(),
    }
    if flow.moving is not None:
        numbers["flow.moving_epe"] = errors(has_prediction & flow.moving).endpoint
    return numbers


def _cameras(estimate, capture, exact):
    """Compute the PSNR with fitted cameras, and their pose errors if `exact`.

    `exact` means that the cameras of the capture are ground truth. The alignment does
    not change the scale, which the trained scene determines.
    """
    numbers = {"heldout.camera_fitted_psnr": known_mean(estimate.scored.psnr)}
    true = cameras.take(capture.cameras, estimate.scored.rows)
    if exact and len(estimate.scored.rows) > 1:
        path = geometry_quality.path_errors(
            estimate.cameras.position, true.position, with_scale=False
        )
        if path.alignment.determined:
            numbers["cameras.ate"] = path.rmse
        relative = geometry_quality.relative_errors(
            estimate.cameras.camera_from_world,
            estimate.cameras.position,
            true.camera_from_world,
            true.position,
        )
        numbers["cameras.rotation_error"] = relative.rotation_deg
    return numbers
