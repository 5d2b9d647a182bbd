"""Measured quality of presets over training time, and their ranking.

`nerfies study results benchmark` writes the curves from the suite `curves` of
`experiments.benchmark`, on built-in scenes. All curves are of small presets.
"""

import functools
import importlib.resources
import json
import math
import statistics
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

CURVES = "method_curves.json"  # next to this file
STATIC = "static"  # name of the scene without motion


class Ranked(NamedTuple):
    """A preset with overrides, and its measured quality."""

    preset: str
    overrides: tuple[str, ...]
    psnr: float  # dB, mean over the scenes


@functools.cache
def curves() -> dict[str, dict[str, dict[str, Any]]]:
    """Read the stored curves.

    Returns:
      By scene, and by preset and overrides separated by spaces: processor seconds of
      training ("seconds") and PSNR of held-out frames in dB ("psnr").
    """
    file = importlib.resources.files("nerfies_jax.evaluation") / CURVES
    return json.loads(file.read_text())


def ranking(
    presets: Collection[str], moves: bool, seconds: float | int | None = None
) -> list[Ranked]:
    """Rank presets by their PSNR after a training time, best first.

    It is the mean over the scenes with motion, or that of the static scene. A shorter
    run is possible, so the PSNR at a time is the highest until then. Learning rates
    decay to the end of a run, so the PSNR before the end of a curve is a lower bound of
    what a run of that length reaches. After the end it is constant. Before the first
    evaluation of a candidate, all are compared at its time.

    Args:
      presets: Names of the candidates.
      moves: True to rank them by the scenes with motion.
      seconds: Processor seconds of training, or None for complete runs.

    Returns:
      The candidates that have curves.
    """
    scenes = [each for name, each in curves().items() if (name != STATIC) == moves]
    methods = [
        method
        for method in scenes[0]
        if method.split()[0] in presets and all(method in scene for scene in scenes)
    ]
    starts = [scene[method]["seconds"][0] for scene in scenes for method in methods]
    at = math.inf if seconds is None else max([seconds, *starts])
    candidates = []
    for method in methods:
        preset, *overrides = method.split()
        psnr = statistics.fmean(_psnr_at(scene[method], at) for scene in scenes)
        candidates.append(Ranked(preset, tuple(overrides), psnr))
    return sorted(candidates, key=lambda candidate: candidate.psnr, reverse=True)


def _psnr_at(curve, seconds):
    """Interpolate the highest PSNR so far over the logarithm of the time."""
    best = np.maximum.accumulate(curve["psnr"])
    return float(np.interp(math.log(seconds), np.log(curve["seconds"]), best))
