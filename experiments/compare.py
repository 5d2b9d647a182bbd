"""Compare runs of one capture: curves, time to quality, images, a table.

    nerfies compare RUN RUN ...
    nerfies compare RUN RUN --psnr 22 24 --frames 4 --out compared

The runs must have the same training frames of the same capture. Prints a table of
metrics, times and sizes, and the seconds of training until each run reached a PSNR.
Saves compare.json, curves.png, and frames.png with held-out frames side by side.
Seconds are those of each run's machine, and the table says where machines differ.
Unfinished runs are compared as far as they got.
"""

import dataclasses
import json
import math
import pathlib
from typing import Any, Literal, NamedTuple

from experiments import cli
from nerfies_jax.runs import platform, representations, run_folder, trust
from nerfies_jax.runtime import console

LARGEST_ERROR = 0.2
UNFITTED = "unfitted.psnr"  # `heldout.psnr` of runs whose main result has fitted codes
SAME = ("capture", "scene", "factor", "max_side", "heldout")
# Columns: key of metrics.json, head, digits behind the point, divisor.
COLUMNS = (
    ("heldout.psnr", "PSNR", 2, 1),
    ("heldout.ssim", "SSIM", 3, 1),
    (UNFITTED, "unfitted PSNR", 2, 1),
    ("train.steps", "steps", 0, 1),
    ("train.seconds", "train s", 0, 1),
    ("train.compile_seconds", "compile s", 0, 1),
    ("render.ms_per_frame", "ms/frame", 1, 1),
    ("parameters", "parameters", 0, 1),
    ("file.bytes", "file MB", 2, 1e6),
    ("memory.peak_bytes", "peak MB", 0, 1e6),
)


@dataclasses.dataclass(frozen=True)
class Compare:
    """Compare runs of one capture: finished, running or interrupted."""

    runs: cli.Positional[tuple[pathlib.Path, ...]]
    """Folders that nerfies reconstruct made."""
    psnr: tuple[float, ...] = ()
    """Qualities in dB to wait for (default: what the runs but the best ended with)."""
    frames: int = 2
    """Held-out frames in the image. 0 renders none."""
    out: pathlib.Path | None = None
    """Folder for compare.json, curves.png and frames.png (default: runs/compare)."""
    trust: cli.Code = ()
    """Code from other packages that the run was trained with, as MODULE:NAME. It is
    loaded only if it is named here again."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Device to render on."""

    def __post_init__(self):
        if len(self.runs) < 2 or len(set(self.runs)) < len(self.runs):
            raise ValueError(
                "name two or more different run folders, got "
                f"{' '.join(map(str, self.runs)) or 'none'}"
            )
        if self.frames < 0:
            raise ValueError(f"--frames {self.frames} must not be negative")


class Compared(NamedTuple):
    """One run as it is compared."""

    name: str
    folder: pathlib.Path
    metrics: dict[str, float | None]
    curve: Any  # curves.Curve
    remark: str = ""  # how far a run is that has not ended


@cli.command(Compare)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    with cli.user_errors():
        run_list = read(args.runs, args.trust if args.frames else None)
        folder = run_folder.new_run_folder(args.out, "compare")
        goals = args.psnr or _default_goals(run_list)
    console.say(table(run_list, goals))
    for line in (*_legend(run_list), *remarks(run_list)):
        console.say(line)
    save(folder, run_list, goals)
    if args.frames:
        kinds = [representations.of_run(each.folder) for each in run_list]
        threads = {kind.resources.threads for kind in kinds if kind is not None}
        with cli.user_errors():
            cli.find_code(args.trust)
            platform.start_jax(
                args.device,
                "all" if "all" in threads else "one",
                wide=not args.trust,
            )
            draw(folder / "frames.png", run_list, args.frames, args.trust)
    console.say(f"saved in {folder}")
    return cli.stored(folder / "compare.json")


def read(folders, trusted_names=None) -> list[Compared]:
    """Read runs of one capture.

    Args:
      folders: Run folders.
      trusted_names: Names MODULE:NAME of code from other packages that may be loaded,
        if the runs are to be rendered.

    Returns:
      The runs.

    Raises:
      ValueError: If a run cannot be compared, with its name.
    """
    from nerfies_jax.runs import curves

    run_list, sources = [], []
    for folder, name in zip(folders, _names(folders), strict=True):
        curve = curves.read(folder)
        try:
            metrics, remark = _progress(folder, name)
            content = json.loads((folder / run_folder.CONFIG).read_text())
            config = content["config"]
            source = config["source"]
            kind = representations.named(content["representation"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{folder}: not a run ({error!r})") from error
        if trusted_names is not None:
            trust.check(folder, content, kind.spec_type, trusted_names)
        run_list.append(Compared(name, folder, metrics, curve, remark))
        same = {key: source.get(key) for key in SAME}
        if source.get("capture") is None:  # a built-in scene is made from the seed
            same["seed"] = config.get("seed")
        sources.append(same)
        for key, value in sources[0].items():
            if sources[-1].get(key) != value:
                raise ValueError(
                    f"{folder} and {folders[0]} did not learn the same frames: {key} "
                    f"is {sources[-1].get(key)} and {value}; compare runs of one "
                    "capture"
                )
    return run_list


def _progress(folder, name):
    """Metrics of a run, and a sentence on how far it is where it has not ended."""
    from nerfies_jax.runs import curves

    scores = folder / "metrics.json"
    course = curves.course_of(folder)
    if course is None or course.ended:
        return json.loads(scores.read_text()), ""
    metrics = {
        "train.steps": course.step,
        "train.seconds": course.seconds,
        "train.compile_seconds": course.compile_seconds,
    }
    return metrics, f"{name} has not ended and has no final scores: {course.line()}."


def _names(folders):
    """The last parts of the paths, as many as tell them apart."""
    parts = [folder.absolute().parts for folder in folders]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(each[-count:]) for each in parts]
        if len(set(names)) == len(names):
            break
    return names


def _default_goals(run_list) -> tuple[float, ...]:
    """Return the final PSNR of all runs except the best, in tenths of a dB."""
    ends = sorted(run.curve.psnr[-1] for run in run_list if run.curve.psnr)
    ends = [math.floor(10 * psnr) / 10 for psnr in ends[:-1] if math.isfinite(psnr)]
    return tuple(dict.fromkeys(ends))


def times(run_list, goals) -> list[list[float | None]]:
    """Return [runs][goals] seconds of training to each PSNR, None where not reached."""
    from nerfies_jax.runs import curves

    return [[curves.seconds_to(run.curve, goal) for goal in goals] for run in run_list]


def _columns(run_list):
    """Return the columns for which any run has a number."""
    return [c for c in COLUMNS if any(_value(run, c[0]) for run in run_list)]


def _value(run, key):
    """Return a metric, with fitted codes if the model has codes of single images."""
    from nerfies_jax.metrics.metric_table import main_key

    if key == UNFITTED:
        return run.metrics.get("heldout.psnr") if _is_fitted(run) else None
    return run.metrics.get(main_key(key, run.metrics))


def _is_fitted(run):
    return run.metrics.get("heldout.fitted_psnr") is not None


def _legend(run_list) -> list[str]:
    """Explain the columns of the table, a line each."""
    from nerfies_jax.metrics.metric_table import METRICS

    better = {"higher": " Higher is better.", "lower": " Lower is better.", "equal": ""}
    entries = [
        (head, METRICS["heldout.psnr" if key == UNFITTED else key])
        for key, head, *_ in _columns(run_list)
    ]
    return [
        f"  {head}: {entry.explanation}{better[entry.direction]}"
        for head, entry in entries
    ]


def table(run_list, goals) -> str:
    """Format a table with a row for each run."""
    columns = _columns(run_list)
    heads = ["run", *(c[1] for c in columns), *(f"s to {goal:g} dB" for goal in goals)]
    lines = [heads]
    for run, seconds in zip(run_list, times(run_list, goals), strict=True):
        cells = [
            _cell(_value(run, key), digits, unit) for key, _, digits, unit in columns
        ]
        cells += ["never" if x is None else f"{x:.0f}" for x in seconds]
        lines.append([run.name, *cells])
    widths = [max(len(line[i]) for line in lines) for i in range(len(heads))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    )


def _cell(value, digits, unit):
    return "-" if value is None else f"{value / unit:,.{digits}f}"


def remarks(run_list) -> list[str]:
    """Report differences between the runs that affect the table."""
    from nerfies_jax.metrics.metric_table import PROTOCOL

    sentences = [run.remark for run in run_list if run.remark]
    fitted_runs = [run.name for run in run_list if _is_fitted(run)]
    if fitted_runs:
        sentences.append(
            f"PSNR, SSIM and curve of {', '.join(fitted_runs)} follow {PROTOCOL}. "
            "Those of runs without codes of single images are of whole frames."
        )
    first = run_list[0]
    for run in run_list:
        frame_count, frames = run.metrics.get("heldout.frames"), len(run.curve.frames)
        if frame_count is not None and frames < frame_count:
            sentences.append(
                f"The curve of {run.name} and its times to a PSNR are of {frames} "
                f"held-out frames, its scores in the table of {frame_count:.0f}."
            )
    for run in run_list[1:]:
        for key in ("cpu", "cores", "xla_cores", "jax"):
            value, reference = run.curve.machine.get(key), first.curve.machine.get(key)
            if value != reference:
                sentences.append(
                    f"Seconds do not compare: {key} is {reference} in {first.name} and "
                    f"{value} in {run.name}."
                )
        if run.curve.frames != first.curve.frames:
            sentences.append(
                f"The curves of {first.name} and {run.name} are of different held-out "
                f"frames ({len(first.curve.frames)} and {len(run.curve.frames)}): "
                "times to a PSNR compare roughly."
            )
        counts = [each.metrics.get("heldout.frames") for each in (first, run)]
        if None not in counts and counts[0] != counts[1]:
            sentences.append(
                f"PSNR and SSIM of {first.name} are of {counts[0]} frames, those of "
                f"{run.name} of {counts[1]}."
            )
    return sentences


def save(folder: pathlib.Path, run_list, goals) -> None:
    """Write compare.json and curves.png."""
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.visualization import panels

    all_seconds = times(run_list, goals)
    write_json(
        folder / "compare.json",
        {
            run.name: {
                "metrics": run.metrics,
                "seconds_to_psnr": dict(zip(map(str, goals), seconds, strict=True)),
                "machine": run.curve.machine,
            }
            for run, seconds in zip(run_list, all_seconds, strict=True)
        },
    )
    histories = {
        run.name: panels.History(run.curve.seconds, run.curve.psnr)
        for run in run_list
        if run.curve.psnr
    }
    if histories:
        panels.curve(histories, folder / "curves.png")


def draw(path: pathlib.Path, run_list, count: int, trusted_names=()) -> None:
    """Draw held-out frames: the truth, the renders of every run and their errors."""
    from nerfies_jax import evaluation, runs
    from nerfies_jax.capture.images import write_png
    from nerfies_jax.visualization import panels

    scores = []
    for each in run_list:
        run = runs.saved_run(each.folder, trusted=trusted_names)
        state = runs.restore(each.folder, run).state
        run = runs.with_found_cameras(run, state)
        rows = evaluation.spread(run.observed.heldout, count)
        draw = evaluation.Renderer(run.model, run.capture.size)
        scores.append(evaluation.score(draw, state, run.observed, rows))
        capture = run.observed
    tiles, captions = [], []
    for place, row in enumerate(scores[0].rows):
        truth = capture.images[row]
        renders = [evaluation.to_uint8(each.color[place]) for each in scores]
        if capture.valid is not None:  # unobserved pixels are no error
            valid = capture.valid[row][..., None]
            truth, renders = truth * valid, [image * valid for image in renders]
        errors = [panels.color_error(x, truth, LARGEST_ERROR).image for x in renders]
        blank = truth * 0 + 255
        tiles += [truth, *renders, blank, *errors]
        captions += [capture.ids[row]]
        captions += [
            f"{run.name}: {each.psnr[place]:.2f} dB"
            for run, each in zip(run_list, scores, strict=True)
        ]
        captions += ["", *(f"error, to {LARGEST_ERROR:g}" for _ in scores)]
    sheet = panels.contact_sheet(tiles, captions, columns=1 + len(run_list))
    write_png(path, sheet)


if __name__ == "__main__":
    main()
