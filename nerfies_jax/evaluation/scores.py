"""Metrics of held-out frames."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.frames import view_of
from nerfies_jax.metrics import image_quality
from nerfies_jax.runtime import events
from nerfies_jax.training.model import Rendering, TrainState, View

Draw = Callable[[TrainState, View], Rendering]  # such as a `Renderer`


class Scored(NamedTuple):
    """Rendered frames and their metrics, in NumPy, with one row per frame."""

    rows: np.ndarray  # of the capture
    color: np.ndarray  # [frames, height, width, 3] float32, clipped to [0, 1]
    alpha: np.ndarray  # [frames, height, width]
    depth: np.ndarray  # [frames, height, width] z-depth, scene units
    psnr: np.ndarray  # dB, of the 8-bit image
    ssim: np.ndarray  # with Gaussian weights, as in scikit-image


class Halves(NamedTuple):
    """Metrics of right halves of frames with codes fitted to their left halves."""

    rows: np.ndarray  # of the capture
    psnr: np.ndarray  # dB, of the 8-bit image
    ssim: np.ndarray
    color: np.ndarray  # of the right halves, [rows, height, width - width // 2, 3]


def score(
    renderer: Draw, state: TrainState, capture: Capture, rows: np.ndarray
) -> Scored:
    """Render frames of a capture and compare them with the captured images.

    Metrics are computed on images rounded to 8 bits, over the observed pixels.

    Args:
      renderer: The renderer.
      state: Trained state.
      capture: The capture.
      rows: Indices of the frames.

    Returns:
      The rendered frames and their metrics.

    Raises:
      ValueError: If there are no frames.
    """
    _check_rows(rows, capture)
    renderings, scores = [], []
    with events.stage("scoring held-out frames", len(rows)) as stage:
        for row in rows:
            rendering = renderer(state, view_of(capture, row))
            truth = capture.images[row].astype(np.float32) / 255
            valid = None if capture.valid is None else capture.valid[row]
            scores.append(jax.device_get(_score(rendering.color, truth, valid)))
            renderings.append(rendering)
            stage.advance()
    psnr, ssim = np.asarray(scores).T
    return Scored(
        rows=np.asarray(rows),
        color=np.clip(np.stack([r.color for r in renderings]), 0, 1),
        alpha=np.stack([r.alpha for r in renderings]),
        depth=np.stack([np.asarray(r.depth) for r in renderings]),
        psnr=psnr,
        ssim=ssim,
    )


def score_halves(
    fit_code: Callable[[View, np.ndarray, np.ndarray | None], Any],
    render: Callable[[View, Any], np.ndarray],
    capture: Capture,
    rows: np.ndarray,
) -> Halves:
    """Evaluate frames with unknown appearance with the protocol of NeRF-W.

    Codes are fitted to the left half of a frame with the network frozen, and the right
    half is evaluated.

    Args:
      fit_code: Function of a view, the left half of its image (uint8 [height, width //
        2, 3]) and its observed pixels (or None), which returns codes.
      render: Function of a view and codes, which returns the whole image.
      capture: The capture.
      rows: Indices of the frames.

    Returns:
      The metrics of the right halves.

    References:
      Martin-Brualla et al. 2021 (NeRF-W), arXiv:2008.02268.
    """
    colors = []
    for row in rows:
        view, image = view_of(capture, row), capture.images[row]
        half = image.shape[1] // 2
        valid = None if capture.valid is None else capture.valid[row, :, :half]
        codes = fit_code(view, image[:, :half], valid)
        colors.append(np.asarray(render(view, codes)))
    return score_right_halves(capture, rows, colors)


def score_right_halves(
    capture: Capture, rows: np.ndarray, colors: np.ndarray | Sequence[np.ndarray]
) -> Halves:
    """Evaluate the right halves of rendered frames.

    Args:
      capture: The capture.
      rows: Indices of the frames.
      colors: Rendered frames, [height, width, 3].

    Returns:
      The metrics.

    Raises:
      ValueError: If there are no frames.
    """
    _check_rows(rows, capture)
    scores = []
    for row, color in zip(rows, colors, strict=True):
        half = color.shape[1] // 2
        truth = capture.images[row, :, half:].astype(np.float32) / 255
        valid = None if capture.valid is None else capture.valid[row, :, half:]
        scores.append(jax.device_get(_score(color[:, half:], truth, valid)))
    psnr, ssim = np.asarray(scores).T
    right = np.stack([color[:, color.shape[1] // 2 :] for color in colors])
    return Halves(np.asarray(rows), psnr, ssim, right)


def _check_rows(rows, capture):
    if not len(rows):
        raise ValueError(
            f"{capture.path or capture.name}: no frames to evaluate; hold out frames "
            "when the capture is read (heldout=8), or pass rows of training frames"
        )


def known_mean(
    values: np.ndarray, mean: Callable[[np.ndarray], Any] = np.mean
) -> float:
    """Compute the mean of the values that are not NaN.

    Metrics of frames without observed pixels are NaN.

    Args:
      values: Values.
      mean: Another statistic in place of the mean.

    Returns:
      The mean, NaN if there are no values.
    """
    values = values[~np.isnan(values)]
    return float(mean(values)) if values.size else float("nan")


@jax.jit
def _score(color, truth, valid):
    image = image_quality.quantize(color)
    if valid is None:
        return image_quality.psnr(image, truth), image_quality.ssim(image, truth)
    return (
        image_quality.masked_psnr(image, truth, valid),
        image_quality.masked_ssim(image, truth, valid),
    )
