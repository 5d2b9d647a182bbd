"""How a run went, kept beside its pictures, to lay runs over each other."""

import json
import math
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

from nerfies_jax.capture.json_files import write_json
from nerfies_jax.measure import clock
from nerfies_jax.training.loop import History

CURVE = "curve.json"


class Curve(NamedTuple):
    """Quality over the time of training; one entry for each evaluation."""

    seconds: tuple[float, ...]  # of training, without compiling
    steps: tuple[int, ...]
    psnr: tuple[float, ...]  # dB, mean of a few held-out frames
    ssim: tuple[float, ...]
    frames: tuple[str, ...]  # names of those frames
    compile_seconds: float
    machine: dict[str, Any]


def write(folder: pathlib.Path, history: History, frames: Sequence[str]) -> None:
    """`curve.json`: every evaluation, every chunk's mean metrics, and the machine."""
    write_json(
        folder / CURVE,
        {
            "evaluations": [_finite(row) for row in history.evaluations],
            "training": [_finite(row) for row in history.rows],
            "frames": list(frames),
            "compile_seconds": history.compile_seconds,
            "machine": clock.machine(),
        },
    )


def _finite(row):
    """JSON has no word for what is not finite: null."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }


def read(folder: pathlib.Path) -> Curve:
    """The curve of a run folder; ValueError where there is none to read."""
    path = folder / CURVE
    if not path.is_file():
        raise ValueError(
            f"{folder}: no {CURVE} here; name the folder of a run that "
            "experiments.reconstruct completed, one from before there was this file "
            "can be resumed for no further steps to get it"
        )
    try:
        stored = json.loads(path.read_text())
        rows = stored["evaluations"]
        return Curve(
            seconds=tuple(float(row["seconds"]) for row in rows),
            steps=tuple(int(row["step"]) for row in rows),
            psnr=tuple(_number(row["psnr"]) for row in rows),
            ssim=tuple(_number(row["ssim"]) for row in rows),
            frames=tuple(stored["frames"]),
            compile_seconds=float(stored["compile_seconds"]),
            machine=dict(stored["machine"]),
        )
    except (json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not the curve of a run ({error!r})") from error


def _number(value):
    return math.nan if value is None else float(value)


def seconds_to(curve: Curve, psnr: float | int) -> float | None:
    """Seconds of training after which the curve stays at or above a PSNR in dB.

    Linear between evaluations; None where it ends below. A curve that falls back under
    it later has not reached it.
    """
    if not curve.psnr or not curve.psnr[-1] >= psnr:
        return None
    last = len(curve.psnr) - 1
    while last > 0 and curve.psnr[last - 1] >= psnr:
        last -= 1
    if last == 0:
        return curve.seconds[0]
    below, above = curve.psnr[last - 1], curve.psnr[last]
    if not math.isfinite(below):
        return curve.seconds[last]
    share = (psnr - below) / (above - below)
    began, ended = curve.seconds[last - 1], curve.seconds[last]
    return began + share * (ended - began)
