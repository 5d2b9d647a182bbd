"""The PSNR of a run over its training, as a figure with a caption for the report."""

import math
import pathlib

from nerfies_jax import evaluation, events
from nerfies_jax.evaluation import Scored, pictures
from nerfies_jax.runs.run import Run
from nerfies_jax.runs.train import Trained


@events.stage("drawing the curve")
def save(path: pathlib.Path, run: Run, trained: Trained, scored: Scored):
    """PSNR against seconds; None where the run ended before it was evaluated.

    Where the curve is of fewer frames than the score, that is marked, too.
    """
    history = trained.result.history
    if not history.evaluations:
        return None
    points = pictures.History(
        [row["seconds"] for row in history.evaluations],
        [row["psnr"] for row in history.evaluations],
    )
    final = None
    if _is_partial(trained, scored):
        counts = len(scored.rows), len(trained.watched)
        psnr = evaluation.known_mean(scored.psnr)
        final = pictures.Final(trained.result.seconds, psnr, *counts)
    pictures.curve({run.config.preset: points}, path, final)
    return path


def _is_partial(trained, scored):
    """Whether the curve is of fewer frames than the score."""
    return len(trained.watched) < len(scored.rows)


def caption(run, trained, scored):
    """Which frames the curve and the score are of, and where the two end."""
    score = f"{evaluation.known_mean(scored.psnr):.2f} dB"
    count = len(trained.watched)
    which = "all of the held-out frames"
    if _is_partial(trained, scored):
        names = ", ".join(run.capture.ids[row] for row in trained.watched)
        which = f"{count} of the {len(scored.rows)} scored held-out frames ({names})"
    last = trained.result.history.evaluations[-1]["psnr"]
    text = f"PSNR during training. The line is the mean over {which}"
    if math.isfinite(last):
        text += f", and ends at {last:.2f} dB"
    if not _is_partial(trained, scored):
        return f"{text}."
    return (
        f"{text}. The mean over all {len(scored.rows)} frames, which is the score of "
        f"the run, is {score} and is marked with a diamond."
    )
