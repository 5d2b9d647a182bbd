"""Quality metrics of the held-out frames of a finished run."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from nerfies_jax import evaluation
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.evaluation import (
    Scored,
    baseline_images,
    fitted_cameras,
    heldout,
    model_flow,
    moving_masks,
    protocol,
)
from nerfies_jax.evaluation.baseline_images import Baselines
from nerfies_jax.evaluation.heldout import Lpips
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.metrics import perceptual
from nerfies_jax.preprocessing import record, usable_paths
from nerfies_jax.runs import baselines_text, budget
from nerfies_jax.runs.config import MoreMetrics
from nerfies_jax.runs.run import Run
from nerfies_jax.runtime import events
from nerfies_jax.training.loop import History
from nerfies_jax.training.model import TrainState

TRACKS = 200  # points of a built-in scene to track
NETWORKS = {"alex": perceptual.ALEX, "vgg": perceptual.VGG}


class Extra(NamedTuple):
    """Additional metrics that the user requested, or whose weights are installed."""

    lpips: Lpips | None
    camera_fits: int  # frames to score also with optimized cameras
    step_profile: bool  # True to measure the parts of a training step
    requires_lpips: bool = False  # False if images may be too small for it


NOTHING = Extra(None, 0, False)


def prepared(more: MoreMetrics) -> Extra:
    """Read the weights of additional metrics, so that errors occur before training.

    Args:
      more: Requested metrics.

    Returns:
      The metrics with their weights.

    Raises:
      ValueError: If a file cannot be used.
    """
    lpips, network = None, NETWORKS[more.lpips_network]
    if more.lpips_weights or perceptual.installed_weights(network) is not None:
        lpips = Lpips(network, perceptual.load(network, more.lpips_weights))
    is_required = bool(more.lpips_weights)
    return Extra(lpips, more.fit_heldout_cameras, more.step_profile, is_required)


def fitting(extra: Extra, size: tuple[int, int]) -> Extra:
    """Check that images are large enough for the additional metrics.

    Args:
      extra: Additional metrics.
      size: Width and height of the images in pixels.

    Returns:
      The metrics, without LPIPS if images are too small and it was not requested.

    Raises:
      ValueError: If they are too small for requested metrics.
    """
    if extra.requires_lpips and extra.lpips is not None:
        perceptual.check_large_enough(extra.lpips.network, size)
    if extra.lpips is not None and min(size) < extra.lpips.network.smallest:
        return extra._replace(lpips=None)
    return extra


@events.stage("measuring quality")
def measure(
    run: Run,
    state: TrainState,
    draw: Draw,
    scored: Scored,
    extra: Extra = NOTHING,
    frame_seconds: float = 0.0,
) -> tuple[dict[str, float], list[str]]:
    """Measure the quality of a run.

    For a built-in scene, tracks and optical flow are compared with the ground truth.

    Args:
      run: The run.
      state: Trained state.
      draw: Renderer of the frames as they were captured.
      scored: Evaluated frames.
      extra: Additional metrics.
      frame_seconds: Seconds to render a frame, which limits the renders for the
        baselines.

    Returns:
      Values by the keys of `heldout.TOLERANCES`, and notes.
    """
    ground_truth = tracks = flow = camera_fit = None
    capture, note = moving_masks.with_masks(run.observed, CACHE / "evidence")
    notes = [note] if note else []
    try:
        truth = protocol.stored_truth(capture)
        if truth is not None:
            ground_truth = protocol.ground_truth(
                capture, truth, len(scored.rows), TRACKS
            )
    except ValueError as error:
        notes.append(f"Tracks were not evaluated: {error}")
    if ground_truth is not None:
        kind, scene = run.representation, (run.spec, run.metadata)
        tracks = kind.scoring.follow(*scene, state, capture, ground_truth)
        move = kind.scoring.mover(*scene)
        if move is not None:
            flow = model_flow.heldout_flow(move, state, capture, scored)
    if extra.camera_fits:
        places = evaluation.spread(np.arange(len(scored.rows)), extra.camera_fits)
        camera_fit = fitted_cameras.fit_cameras(
            run.model,
            draw,
            state,
            run.capture,
            scored.rows[places],
            observed=run.observed,
        )
        before, after = map(
            evaluation.known_mean, (scored.psnr[places], camera_fit.scored.psnr)
        )
        notes.append(
            f"PSNR of {len(places)} held-out frames: {before:.2f} dB with the cameras "
            f"of the capture, {after:.2f} dB with cameras optimized for these frames "
            f"({camera_fit.converged.sum()} of {len(places)} converged)."
        )
    if extra.lpips is not None:
        notes.append(f"LPIPS uses {extra.lpips.network.name}, version 0.1.")
    numbers = heldout.heldout_metrics(
        scored,
        capture,
        lpips=extra.lpips,
        known=ground_truth,
        followed=tracks,
        flow=flow,
        fitted=camera_fit,
        baselines=_baselines(run, state, draw, scored.rows, frame_seconds),
    )
    return numbers, notes


def _baselines(run, state, draw, rows, frame_seconds):
    counts = budget.static_renders(frame_seconds, len(rows), run.observed.size)
    return Baselines(
        baseline_images.neighbor_means(run.observed, rows),
        baseline_images.time_averages(draw, state, run.observed, rows, *counts),
    )


def tracked_share(run: Run, numbers: Mapping[str, float]) -> float | None:
    """Return the share of moving pixels near the tracks that a run started from.

    Preprocessing is read from the cache, in which the initialization stored it.

    Args:
      run: The run.
      numbers: Its metrics by key.

    Returns:
      The share. None if the motion improves the held-out frames, so that no cause is
      needed, or if it was not initialized from tracks.
    """
    start = getattr(run.spec, "start", None)
    if numbers.get("motion.gain", 0.0) >= baselines_text.WORSE_DB:
        return None
    if start is None or start.motion != "tracks":
        return None
    evidence = record.cached(run.capture, CACHE / "evidence", start.use_depths)
    return None if usable_paths.unusable(evidence) else usable_paths.coverage(evidence)


def check_learned(history: History, scored: Scored) -> None:
    """Refuse to report a run that learned nothing or cannot be evaluated.

    Args:
      history: History of the run.
      scored: Evaluated frames.

    Raises:
      FloatingPointError: If the loss was 0 in all steps, or no evaluated frame has a
        PSNR.
    """
    losses = [row["loss"] for row in history.rows if "loss" in row]
    if losses and not any(losses):
        raise FloatingPointError(
            "no report: the loss was 0 in all steps, so nothing was learned; check "
            "the masks of valid and of moving pixels of the capture"
        )
    if len(scored.psnr) and np.isnan(scored.psnr).all():
        raise FloatingPointError(
            f"no report: none of the {len(scored.psnr)} scored held-out frames has a "
            "PSNR; check the masks of their valid pixels"
        )
