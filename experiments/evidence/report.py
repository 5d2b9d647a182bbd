"""One capture looked at: what was found, in words, numbers and a picture."""

import math
import pathlib
import time
from collections.abc import Mapping
from typing import Any

from nerfies_jax import runs
from nerfies_jax.capture.capture import Capture, describe
from nerfies_jax.capture.json_files import write_json
from nerfies_jax.capture.synthetic import SceneTruth
from nerfies_jax.evaluation import protocol
from nerfies_jax.preprocessing import (
    against_truth,
    contact_sheet,
    record,
    summary,
    view_set,
)
from nerfies_jax.preprocessing.against_truth import LATER, Errors
from nerfies_jax.preprocessing.record import Evidence
from nerfies_jax.runs import run_folder
from nerfies_jax.runs.config import CaptureSource
from nerfies_jax.runs.platform import CACHE
from nerfies_jax.runtime import console
from nerfies_jax.visualization import panels


def look(source: CaptureSource, seed: int, out: pathlib.Path | None) -> dict[str, Any]:
    """Gather, or read what was gathered, and say what it is."""
    capture = runs.stored_capture(source, seed)
    stem = f"evidence-{'-'.join(capture.name.replace('/', ' ').split())}"
    results = run_folder.new_run_folder(out, stem)
    for line in describe(capture):
        console.say(line)
    console.say()
    path = record.file_of(capture, CACHE / "evidence")
    if path.exists():
        console.say("gathered before, and read again")
    folder = CACHE / "evidence"
    evidence = record.cached(capture, folder, tell=_PartLog())
    views = view_set.in_time_order(record.looked_at(capture, evidence.factor))
    numbers = summary.of(views, evidence)
    console.say("\n".join(summary.lines(numbers, evidence)))
    stored = {"capture": capture.name, "found": as_json(numbers._asdict())}
    truth = protocol.stored_truth(capture)
    # What other tools found is theirs to judge.
    if truth is not None and capture.given is None:
        errors = errors_of(capture, truth, evidence)
        console.say("\n".join(error_lines(errors)))
        stored["errors"] = as_json(errors._asdict())
    panels.save(contact_sheet.followed(views, evidence), results / "tracks.png")
    write_json(results / "evidence.json", stored)
    console.say(f"frames with tracks: {results / 'tracks.png'}")
    console.say(f"record: {path if path.exists() else 'not kept'}")
    return stored


def errors_of(capture: Capture, truth: SceneTruth, evidence: Evidence) -> Errors:
    """Against the truth of a built-in scene."""
    points = against_truth.true_points(capture, truth, evidence)
    return against_truth.errors(capture, evidence, points)


def error_lines(errors: Errors) -> list[str]:
    """For a person."""
    lines = [
        f"against the truth: {errors.false_share:.2%} of all pixels are marked as "
        "moving and stand still"
    ]
    if math.isfinite(errors.mask_iou):
        lines.append(f"  mask: intersection over union {errors.mask_iou:.3f}")
    if math.isfinite(errors.track_px):
        lines.append(
            f"  moving points, {LATER} frames on: {errors.track_px:.2f} px off "
            f"(median), {errors.track_lost:.0%} lost"
        )
    if math.isfinite(errors.path_error):
        lines.append(
            f"  their places: {errors.path_error:.2%} of the distance off (median)"
        )
    return lines


def as_json(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same with None for what is not a number."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }


class _PartLog:
    """Prints each part as it begins."""

    def __init__(self):
        self._began = time.perf_counter()

    def __call__(self, part):
        console.say(f"{time.perf_counter() - self._began:6.1f} s  {part} ...")
