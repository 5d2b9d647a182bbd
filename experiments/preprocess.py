"""Preprocess a capture: optical flow, tracks, masks of moving objects, rigid groups.

    nerfies preprocess CAPTURE
    nerfies preprocess --scene fast --out runs/fast-preprocessed

Prints the share of pixels with flow, moving objects, tracks and their 3D paths, static
points and rigid groups. Draws frames with masks and tracks. The result is stored where
`reconstruct` finds it. For built-in scenes, whose ground truth is known, it reports the
errors.
"""

import dataclasses
import math
import pathlib
import time
from collections.abc import Mapping
from typing import Any

from experiments import cli
from nerfies_jax.runs import platform
from nerfies_jax.runtime import console


@dataclasses.dataclass(frozen=True)
class Preprocess:
    """Preprocess a capture, or a built-in scene."""

    source: cli.Source = cli.NamedSource()
    seed: int = 0
    """Seed of the built-in scene."""
    out: pathlib.Path | None = None
    """Folder for tracks.png and preprocessing.json (default:
    runs/preprocessed-CAPTURE)."""

    def __post_init__(self):
        cli.check_out_folder(self.out)


@cli.command(Preprocess)
def main(args):
    """Preprocess the capture of the command line. Wrong input ends with exit code 2."""
    with cli.user_errors():
        platform.start_jax("cpu")
        from nerfies_jax import runs
        from nerfies_jax.capture.capture import describe
        from nerfies_jax.capture.images import write_png
        from nerfies_jax.capture.json_files import write_json
        from nerfies_jax.preprocessing import contact_sheet, record, summary, view_set
        from nerfies_jax.runs import run_folder

        capture = runs.stored_capture(cli.plain(args.source), args.seed)
        stem = f"preprocessed-{'-'.join(capture.name.replace('/', ' ').split())}"
        out = run_folder.new_run_folder(args.out, stem)
        console.say("\n".join([*describe(capture), ""]))
        cache = platform.CACHE / "evidence"
        path = record.file_of(capture, cache)
        if path.exists():
            console.say("already preprocessed; the stored result is read")
        evidence = record.cached(capture, cache, tell=_PartLog())
        views = view_set.in_time_order(record.downscale(capture, evidence.factor))
        numbers = summary.of(views, evidence)
        console.say("\n".join(summary.lines(numbers, evidence)))
        document = {"capture": capture.name, "found": _as_json(numbers._asdict())}
        errors = _errors(capture, evidence)
        if errors is not None:
            document["errors"] = _as_json(errors._asdict())
            console.say("\n".join(_error_lines(errors)))
        write_png(out / "tracks.png", contact_sheet.followed(views, evidence))
        write_json(out / "preprocessing.json", document)
    console.say(f"frames with tracks: {out / 'tracks.png'}")
    console.say(f"stored result: {path if path.exists() else 'none'}")
    return document


def _errors(capture, evidence):
    """Compute the errors in a built-in scene, unless other tools made the result."""
    from nerfies_jax.capture import pinholes
    from nerfies_jax.evaluation import protocol
    from nerfies_jax.preprocessing import against_truth

    truth = protocol.stored_truth(capture)
    # With a lens, the tracks are of undistorted pixels and the truth is not.
    lens = pinholes.has_lens(capture.cameras)
    if truth is None or capture.external is not None or lens:
        return None
    points = against_truth.true_points(capture, truth, evidence)
    return against_truth.errors(capture, evidence, points)


def _error_lines(errors: Any) -> list[str]:
    """Describe the errors in a built-in scene."""
    from nerfies_jax.preprocessing.against_truth import LATER

    lines = [
        f"compared with the ground truth: {errors.false_share:.2%} of all pixels are "
        "static and marked as moving"
    ]
    if math.isfinite(errors.mask_iou):
        lines.append(f"  mask: intersection over union {errors.mask_iou:.3f}")
    if math.isfinite(errors.track_px):
        lines.append(
            f"  moving points {LATER} frames later: error {errors.track_px:.2f} px "
            f"(median), {errors.track_lost:.0%} lost"
        )
    if math.isfinite(errors.path_error):
        lines.append(
            f"  their 3D positions: error {errors.path_error:.2%} of the distance "
            "(median)"
        )
    return lines


def _as_json(values: Mapping[str, Any]) -> dict[str, Any]:
    """Replace numbers that are not finite by None."""
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


if __name__ == "__main__":
    main()
