"""What got worse since an earlier run: `--check BASELINE`."""

import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

from nerfies_jax.measure import clock
from nerfies_jax.measure.clock import Metric


def read(path: pathlib.Path, name: str) -> dict[str, Metric]:
    """The metrics of an earlier run's file `name`; ValueError where there are none."""
    try:
        return clock.read_metrics(path)
    except OSError as error:
        raise ValueError(
            f"--check {path}: cannot be read ({error.strerror}); name an earlier "
            f"run's {name}"
        ) from error


def changes(metrics: Sequence[Metric], before: Mapping[str, Metric]) -> list[str]:
    """One line for each number that is worse than before by more than its tolerance.

    Only what both runs have is held; a number that was unknown before never is worse.
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
