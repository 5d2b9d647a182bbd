"""Figure of the PSNR of a run during training, with a caption for the report."""

import math
import pathlib
from typing import NamedTuple

from nerfies_jax.metrics.metric_table import PROTOCOL
from nerfies_jax.runs import curves
from nerfies_jax.runs.run import Run
from nerfies_jax.runs.train import Trained
from nerfies_jax.runtime import events
from nerfies_jax.visualization import panels


class Result(NamedTuple):
    """Final PSNR of a run."""

    psnr: float  # dB
    frames: int  # number of evaluated frames
    is_fitted: bool  # True with codes fitted to half of each frame


@events.stage("drawing the curve")
def save(path: pathlib.Path, run: Run, trained: Trained, result: Result):
    """Plot PSNR against seconds of training.

    If the curve covers fewer frames than the final metrics, the final PSNR is marked
    separately.

    Args:
      path: The image file.
      run: The run.
      trained: Its training.
      result: Its final PSNR.

    Returns:
      The path, or None if the run ended before its first evaluation.
    """
    rows = curves.of_held_out(trained.result.history.evaluations)
    if not rows:
        return None
    points = panels.History(
        [row["seconds"] for row in rows], [row["psnr"] for row in rows]
    )
    final = None
    if _is_partial(trained, result):
        counts = result.frames, len(trained.watched)
        final = panels.Final(trained.result.seconds, result.psnr, *counts)
    panels.curve({run.config.preset_name: points}, path, final)
    return path


def _is_partial(training, result):
    """Test if the curve covers fewer frames than the final metrics."""
    return len(training.watched) < result.frames


def caption(run: Run, trained: Trained, result: Result) -> str:
    """Describe the frames of the curve and of the final metrics, and their values.

    Args:
      run: The run.
      trained: Its training.
      result: Its final PSNR.

    Returns:
      The caption.
    """
    partial = _is_partial(trained, result)
    frames = "all held-out frames"
    if partial:
        names = ", ".join(run.capture.ids[row] for row in trained.watched)
        count = len(trained.watched)
        frames = f"{count} of the {result.frames} scored held-out frames ({names})"
    last = curves.of_held_out(trained.result.history.evaluations)[-1]["psnr"]
    protocol = f" ({PROTOCOL})" if result.is_fitted else ""
    text = f"PSNR during training{protocol}. The line is the mean over {frames}"
    if math.isfinite(last):
        text += f" and ends at {last:.2f} dB"
    if not partial:
        return f"{text}."
    return (
        f"{text}. The mean over all {result.frames} frames, which is the score of "
        f"the run, is {result.psnr:.2f} dB and is marked with a "
        "diamond."
    )
