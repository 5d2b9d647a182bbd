"""Scores of frames that were never learned from."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from nerfies_jax import events
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.frames import view_of
from nerfies_jax.measure import image_quality
from nerfies_jax.training.model import Rendering, TrainState, View

Draw = Callable[[TrainState, View], Rendering]  # as a `Renderer` does


class Scored(NamedTuple):
    """Frames as rendered, and their scores; NumPy, one row per frame."""

    rows: np.ndarray  # of the capture
    color: np.ndarray  # [frames, height, width, 3] float32, clipped to [0, 1]
    alpha: np.ndarray  # [frames, height, width]
    depth: np.ndarray  # [frames, height, width] z-depth, scene units
    psnr: np.ndarray  # dB, of the 8-bit picture
    ssim: np.ndarray  # scikit-image's Gaussian form


class Halves(NamedTuple):
    """Scores of the right halves of frames whose codes were fitted to the left ones."""

    rows: np.ndarray  # of the capture
    psnr: np.ndarray  # dB, of the 8-bit picture
    ssim: np.ndarray


def score(
    renderer: Draw, state: TrainState, capture: Capture, rows: np.ndarray
) -> Scored:
    """Render frames of a capture and compare them with what was filmed.

    Scores are of the picture as an 8-bit file would hold it, over the filmed pixels.
    Raises ValueError for no frames.
    """
    _check_some(rows, capture)
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
        depth=np.stack([r.depth for r in renderings]),
        psnr=psnr,
        ssim=ssim,
    )


def score_halves(
    fit_code: Callable[[View, np.ndarray, np.ndarray | None], Any],
    render: Callable[[View, Any], Rendering],
    capture: Capture,
    rows: np.ndarray,
) -> Halves:
    """Score frames whose appearance was never learned, by NeRF-W's protocol.

    `fit_code(view, left, valid)` finds the codes of a frame from its left half alone,
    uint8 [height, width // 2, 3] and which of it was filmed (or None), with the network
    frozen; `render(view, codes)` draws the whole frame with them, and its right half
    is scored (Martin-Brualla et al. 2021).
    """
    colors = []
    for row in rows:
        view, picture = view_of(capture, row), capture.images[row]
        half = picture.shape[1] // 2
        left = None if capture.valid is None else capture.valid[row, :, :half]
        codes = fit_code(view, picture[:, :half], left)
        colors.append(np.asarray(render(view, codes).color))
    return score_right_halves(capture, rows, colors)


def score_right_halves(
    capture: Capture, rows: np.ndarray, colors: np.ndarray | Sequence[np.ndarray]
) -> Halves:
    """Scores of the right halves of rendered frames [height, width, 3].

    Raises ValueError for no frames.
    """
    _check_some(rows, capture)
    scores = []
    for row, color in zip(rows, colors, strict=True):
        half = color.shape[1] // 2
        truth = capture.images[row, :, half:].astype(np.float32) / 255
        valid = None if capture.valid is None else capture.valid[row, :, half:]
        scores.append(jax.device_get(_score(color[:, half:], truth, valid)))
    psnr, ssim = np.asarray(scores).T
    return Halves(np.asarray(rows), psnr, ssim)


def _check_some(rows, capture):
    if not len(rows):
        raise ValueError(
            f"{capture.path or capture.name}: no rows to score; hold frames out when "
            "the capture is read (heldout=8), or give rows of its training frames"
        )


def known_mean(
    values: np.ndarray, mean: Callable[[np.ndarray], Any] = np.mean
) -> float:
    """The mean of what is not NaN, as a frame without a filmed pixel scores.

    NaN over nothing. `mean` may be another statistic.
    """
    values = values[~np.isnan(values)]
    return float(mean(values)) if values.size else float("nan")


@jax.jit
def _score(color, truth, valid):
    picture = image_quality.quantize(color)
    if valid is None:
        return image_quality.psnr(picture, truth), image_quality.ssim(picture, truth)
    return (
        image_quality.masked_psnr(picture, truth, valid),
        image_quality.masked_ssim(picture, truth, valid),
    )
