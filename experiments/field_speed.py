"""What grids and MLPs of small fields reach in equal processor time, and how they draw.

    python -m experiments.field_speed --captures CAPTURE CAPTURE --out field_speed.json
    python -m experiments.field_speed --captures CAPTURE --presets nerf-grid-small
    python -m experiments.field_speed --captures CAPTURE --max-side 256 --seeds 3
    python -m experiments.field_speed --presets nerfies-small nerfies-small+tracks

Each preset (`+tracks`: its motion fitted to tracks first) is trained on each capture,
once for each seed and each of the given processor seconds, over the steps that it can
make in them, its schedules in proportion, and scored on frames that it does not learn
from, *moving* where something moves (by the capture's masks, or the pictures' where it
has none); compiling counts nothing, nor does a start from tracks. *spent* is what these
steps took in the end. After the longest a frame is drawn behind the survey of its empty
space (`nerfies_jax.skipping`) and by the full quadrature: milliseconds are medians of
the processor over five frames, without the survey, which has a column of its own (a
difference of two timings, empty where it is below their noise), and
decibels are of the difference between the two. Over several seeds the table has means,
and beside a PSNR its standard deviation. What is in `--out` already is not measured
again: an interrupted run goes on, and more `--seeds` add those that it lacks. Rows of
`nerf-small`, `nerfies-small+tracks` and `d-nerf-grid-small` are of before a template's
bottleneck met the first layer of its color; with it their steps are shorter. Rows of
120 s alone are of today, with an elastic penalty at one step of five; others are older.
"""

import dataclasses
import itertools
import math
import pathlib
import statistics
import time

from experiments import cli, kept, markdown
from nerfies_jax import console
from nerfies_jax.runs import platform, representations
from nerfies_jax.training.track_start import FROM_TRACKS

TRACKS = "+tracks"
PRESETS = ("nerf-small", "nerf-grid-small")
PRESETS += ("nerfies-small", "nerfies-small" + TRACKS, "nerfies-grid-small")
FRAMES = 5  # timed, after one that makes the survey
SCORES = (("psnr", 2), ("ssim", 3), ("moving_psnr", 2))  # and their digits
TIMES = ("skipped_ms", "full_ms", "survey_ms")
PILOT_STEPS = 50  # that tell what one takes


@dataclasses.dataclass(frozen=True)
class FieldSpeed:
    """Train small fields for equal processor seconds, and time their frames."""

    captures: tuple[pathlib.Path, ...] = ()
    """Folders (default: the built-in scene)."""
    max_side: int | None = None
    """Read the pictures of captures with no side longer than this, in pixels."""
    presets: tuple[str, ...] = PRESETS
    """Small radiance fields."""
    seconds: tuple[float, ...] = (60.0, 120.0, 300.0)
    """Of the processor, rising: a training for each."""
    size: tuple[int, int] = (256, 192)
    """Of the frames that are timed, pixels."""
    seeds: int = 1
    """Trainings of each preset on each capture, from keys 0, 1, ..."""
    out: pathlib.Path = pathlib.Path("field_speed.json")
    """Keeps the numbers."""

    def __post_init__(self):
        cli.check_out_file(self.out, continued=True)
        cli.check_presets(name.removesuffix(TRACKS) for name in self.presets)
        rising = list(self.seconds) == sorted(set(self.seconds))
        if not self.seconds or not rising or self.seconds[0] <= 0:
            raise ValueError("--seconds: positive and rising, as 60 120 300")
        if self.seeds < 1:
            raise ValueError(f"--seeds {self.seeds}: train at least once")


@cli.command(FieldSpeed)
def main(args):
    """Measure what is missing and keep it; exit code 2 where input is wrong."""
    with cli.user_errors():
        platform.start_jax("cpu")
        captures = _captures(args.captures, args.max_side)
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.measure import clock

    stored = kept.rows(args.out, rows=list)
    rows = stored.get("rows", [])
    for seed, name, preset in itertools.product(
        range(args.seeds), captures, args.presets
    ):
        cell = {"capture": name, "preset": preset, "size": list(args.size)}
        cell |= {"seconds": list(args.seconds), "seed": seed}
        if any(cell.items() <= row.items() for row in rows):
            continue
        found = measured(captures[name], preset, args.seconds, args.size, seed)
        rows.append(cell | found)
        machine = clock.beside(clock.machine(), stored.get("machine", {}))
        stored = {"machine": machine, "rows": rows}
        write_json(args.out, stored)
        console.say("  ".join(f"{k} {v}" for k, v in rows[-1].items()))
    return stored


def _captures(folders, max_side):
    """Captures by name and size, as rows of another size are others."""
    from nerfies_jax import runs

    if not folders:
        found = {"default": runs.built_in_scene("default")}
    elif len({folder.name for folder in folders}) < len(folders):
        raise ValueError("--captures: two folders of one name share a row; rename one")
    else:
        found = {
            folder.name: runs.load_capture(folder, max_side=max_side)
            for folder in folders
        }
    return {f"{name} {one.size[0]}x{one.size[1]}": one for name, one in found.items()}


def measured(capture, preset: str, seconds, size: tuple[int, int], seed: int) -> dict:
    """Scores after each of the seconds, and what a frame takes after the last."""
    from nerfies_jax import evaluation
    from nerfies_jax.capture.cache import CACHE
    from nerfies_jax.evaluation import heldout, moving_masks
    from nerfies_jax.runs import plan

    masked, _ = moving_masks.with_masks(capture, CACHE / "evidence")
    whole = _named(preset)[1].steps
    a_step = _trained(capture, preset, whole, seed, PILOT_STEPS)[0] / PILOT_STEPS
    scores, ssim, moving, steps, spent = [], [], [], [], []
    for limit in seconds:
        steps.append(plan.rounded(limit / a_step))
        took, model, state = _trained(capture, preset, steps[-1], seed)
        renderer = evaluation.Renderer(model, capture.size)
        scored = evaluation.score(renderer, state, capture, capture.heldout)
        found = heldout.heldout_metrics(scored, masked)
        scores.append(found["heldout.psnr"])
        ssim.append(found["heldout.ssim"])
        moving.append(found.get("heldout.moving_psnr"))  # none where nothing moves
        spent.append(took)
    learned = {"psnr": scores, "ssim": ssim, "moving_psnr": moving}
    learned |= {"steps": steps, "spent": spent}
    return learned | drawn(model, state, capture, size)


def _named(preset):
    """The representation of a preset, and what it trains."""
    from nerfies_jax.training import specs

    name = preset.removesuffix(TRACKS)
    representation = representations.of_preset(name)
    spec = representation.presets[name]
    if name != preset:
        spec = specs.override(spec, (FROM_TRACKS,))
    return representation, spec


def _trained(capture, preset, planned, seed, steps=None):
    """Processor seconds of so many of the planned steps, the model, and its state."""
    import jax
    import rich.console

    from nerfies_jax import evaluation
    from nerfies_jax.training import loop

    representation, spec = _named(preset)
    spec = representation.with_steps(spec, planned)
    model = representation.build(spec, representation.metadata_of(capture, spec))
    state = model.init(capture, jax.random.key(seed))
    frames = evaluation.frames_of(capture, model.required_data)
    quiet = rich.console.Console(quiet=True)
    began = time.process_time()
    ended = loop.fit(model, state, frames, steps=steps or planned, console=quiet)
    if ended.stopped_by.startswith("SIG"):
        raise SystemExit("stopped; the same command goes on with what is missing")
    if ended.stopped_by != "steps":
        raise RuntimeError(f"{preset}: training ended early ({ended.stopped_by})")
    spent = ended.training_share * (time.process_time() - began)
    return spent, model, ended.state


def drawn(model, state, capture, size: tuple[int, int]) -> dict:
    """Milliseconds of a frame with and without a survey, and how alike the two are."""
    import numpy as np

    from nerfies_jax import evaluation
    from nerfies_jax.evaluation.frames import resized, spread

    rows = spread(capture.heldout, FRAMES)
    views = [
        resized(evaluation.view_of(capture, row), capture.size, size)
        for row in (rows[0], *rows)
    ]
    record, pictures = {}, {}
    for name, one in (("skipped", model), ("full", model._replace(surveyed=None))):
        renderer = evaluation.Renderer(one, size)
        pictures[name] = [renderer(state, view).color for view in views]
        ms = 1e3 * np.asarray(renderer.cpu_seconds)
        record[f"{name}_ms"] = float(np.median(ms[1:]))
        if name == "skipped":
            record["survey_ms"] = float(ms[0] - record["skipped_ms"])
    pairs = zip(pictures["skipped"], pictures["full"], strict=True)
    worst = max(float(np.mean((one - other) ** 2)) for one, other in pairs)
    record["alike_db"] = None if worst == 0 else -10 * math.log10(worst)
    return record


def page(stored) -> str:
    """The page in docs/results below the docstring."""
    heads = (
        "capture",
        "preset",
        "s",
        "seeds",
        "steps",
        "spent, s",
        "PSNR",
        "SSIM",
        "moving",
        "frame, ms",
    )
    heads += ("full, ms", "survey, ms", "alike, dB")
    cells = {}
    for row in stored["rows"]:
        key = row["capture"], row["preset"], *row["size"], *row["seconds"]
        cells.setdefault(key, []).append(row)
    rows = []
    for seeds in cells.values():
        one = seeds[0]
        for place, limit in enumerate(one["seconds"]):
            last = place == len(one["seconds"]) - 1
            times = [_mean(seeds, name) if last else None for name in TIMES]
            times = [None if time is None or time < 0 else time for time in times]
            steps, spent = (
                statistics.fmean(row[name][place] for row in seeds)
                for name in ("steps", "spent")
            )
            rows.append(
                [
                    one["capture"],
                    one["preset"],
                    f"{limit:g}",
                    str(len(seeds)),
                    markdown.number(steps, 0),
                    markdown.number(spent, 0),
                    *(
                        _over_seeds([_of(row, name, place) for row in seeds], digits)
                        for name, digits in SCORES
                    ),
                    *(markdown.number(number, 0) for number in times),
                    markdown.number(_mean(seeds, "alike_db") if last else None, 1),
                ]
            )
    return markdown.table(heads, rows, words=2)


def _mean(rows, name):
    """Over seeds, None where none has a number: frames that are alike to the bit."""
    there = [row[name] for row in rows if row[name] is not None]
    return statistics.fmean(there) if there else None


def _of(row, name, place):
    """None in rows that were kept before this was scored."""
    return row[name][place] if name in row else None


def _over_seeds(values, digits):
    return "" if None in values else markdown.over_seeds(values, digits)


if __name__ == "__main__":
    main()
