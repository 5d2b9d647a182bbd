"""The best state of a run, by the validation of frames that it was not trained on."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

VALIDATION = "validation"  # name of the hook whose PSNR decides
# An earlier state must be better than the last one by this much, because evaluations of
# a few frames vary by a few hundredths.
MARGIN_DB = 0.1


def best_step(evaluations: Iterable[Mapping[str, Any]]) -> int | None:
    """Return the step of the state to keep.

    Args:
      evaluations: Evaluations of a history.

    Returns:
      The step of the last validation, or of the highest PSNR if that is better by more
      than `MARGIN_DB`. None without validations.
    """
    scores = psnr_by_step(evaluations)
    highest = highest_step(evaluations)
    if highest is None:
        return None
    last = max(scores)
    return highest if scores[highest] > scores[last] + MARGIN_DB else last


def highest_step(evaluations: Iterable[Mapping[str, Any]]) -> int | None:
    """Return the step of the highest PSNR, the last of equal ones.

    Args:
      evaluations: Evaluations of a history.

    Returns:
      The step, or None without validations.
    """
    scores = psnr_by_step(evaluations)
    return max(scores, key=lambda step: (scores[step], step), default=None)


def psnr_by_step(evaluations: Iterable[Mapping[str, Any]]) -> dict[int, float]:
    """Return the finite PSNR of each validation.

    Args:
      evaluations: Evaluations of a history.

    Returns:
      PSNR in dB by step.
    """
    return {
        row["step"]: row["psnr"]
        for row in evaluations
        if row["hook"] == VALIDATION and math.isfinite(row["psnr"])
    }
