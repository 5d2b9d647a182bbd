"""Comparison of metrics with those of an earlier run."""

import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

from nerfies_jax.metrics import clock
from nerfies_jax.metrics.clock import Metric


def read(path: pathlib.Path, name: str) -> dict[str, Metric]:
    """Read the metrics of an earlier run.

    Args:
      path: The file.
      name: Usual name of such a file, for the error message.

    Returns:
      Metrics by key.

    Raises:
      ValueError: If the file cannot be read.
    """
    try:
        return clock.read_metrics(path)
    except OSError as error:
        raise ValueError(
            f"{path}: cannot be read ({error.strerror}); pass the {name} of an earlier "
            "run"
        ) from error


def changes(metrics: Sequence[Metric], before: Mapping[str, Metric]) -> list[str]:
    """List the metrics that are worse than before by more than their tolerance.

    Only metrics of both runs are compared. Metrics that were not finite before are
    skipped.

    Args:
      metrics: Metrics of the later run.
      before: Metrics of the earlier run by key.

    Returns:
      One line for each.
    """
    lines = []
    for metric in metrics:
        old = before.get(metric.key)
        if old is None or not np.isfinite(old.value) or metric.key.endswith(".spread"):
            continue
        if not metric.holds(old.value):
            lines.append(
                f"worse: {metric.key} {metric.value:.4g} {metric.unit}, was "
                f"{old.value:.4g} (tolerance {metric.tolerance:.3g})"
            )
    return lines
