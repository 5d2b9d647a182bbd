"""Losses and metrics of a run over time, from its events.

They are in `events.jsonl` during the run. `curve.json` holds a summary after its end.
"""

import math
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from nerfies_jax.capture.errors import UNEXPECTED_CONTENT, FileError
from nerfies_jax.capture.json_files import read_json, write_json
from nerfies_jax.metrics import clock
from nerfies_jax.runs import event_log
from nerfies_jax.runtime.events import Event
from nerfies_jax.training.loop import History

CURVE = "curve.json"
HELD_OUT = "held out"  # name of the hook that evaluates held-out frames


class Curve(NamedTuple):
    """Quality over the time of training, with one entry for each evaluation."""

    seconds: tuple[float, ...]  # of training, without compilation
    steps: tuple[int, ...]
    psnr: tuple[float, ...]  # dB, mean over the frames below
    ssim: tuple[float, ...]
    frames: tuple[str, ...]  # names of those frames
    compile_seconds: float
    machine: dict[str, Any]
    # Processor time of training on all cores, NaN in runs of earlier versions.
    cpu_seconds: tuple[float, ...] = ()


class Course(NamedTuple):
    """Training of a run so far, from its events.

    Rows are dictionaries with `step`, `seconds` and `cpu_seconds` of training and the
    metrics, in the order of steps. If a resumed run repeated steps, only the last
    repetition is kept.
    """

    training: tuple[dict[str, Any], ...] = ()  # subsampled mean metrics of chunks
    evaluations: tuple[dict[str, Any], ...] = ()  # also with `hook`
    frames: tuple[str, ...] = ()  # evaluated held-out frames
    step: int = 0  # completed
    steps: int | None = None  # requested
    seconds: float = 0.0  # of training
    compile_seconds: float = 0.0
    stopped_by: str | None = None  # None while it runs, or if it was killed
    machine: dict[str, Any] = {}  # noqa: RUF012  (never changed)

    @property
    def ended(self) -> bool:
        """True if training ended by itself and was neither killed nor interrupted."""
        return self.stopped_by in ("steps", "seconds", "non-finite")

    def line(self) -> str:
        """Describe the progress of the run, such as `step 1,200 of 30,000, 21.30 dB`.

        Returns:
          The text.
        """
        text = f"step {self.step:,}"
        if self.steps is not None:
            text += f" of {self.steps:,}"
        rows = of_held_out(self.evaluations)
        scores = [row["psnr"] for row in rows if row.get("psnr")]
        if scores:
            text += f", {scores[-1]:.2f} dB over {len(self.frames)} held-out frames"
        return text


def of_held_out(evaluations: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the evaluations of held-out frames, without those of other hooks.

    Args:
      evaluations: Evaluations of a run.

    Returns:
      The rows, in the same order.
    """
    return [row for row in evaluations if row.get("hook", HELD_OUT) == HELD_OUT]


def course(events: Iterable[Event]) -> Course:
    """Summarize the events of a run.

    Args:
      events: Events, from `event_log.read_events`.

    Returns:
      Rows of training and of evaluations, and the progress of the run.
    """
    training: list[dict[str, Any]] = []
    evaluations: list[dict[str, Any]] = []
    numbers: dict[str, Any] = {}
    for event in events:
        try:
            kind = event["kind"]
            if kind == "train":
                training.append(_row(event))
                numbers |= {name: event[name] for name in _NUMBERS}
            elif kind == "evaluation":
                evaluations.append({"hook": str(event["hook"]), **_row(event)})
            elif kind == "evaluation_frames":
                numbers["frames"] = tuple(map(str, event["frames"]))
            elif kind == "run":
                if event["status"] == "resume":
                    # Steps after the checkpoint are repeated.
                    training = _until(training, event["step"])
                    evaluations = _until(evaluations, event["step"])
                numbers["stopped_by"] = event.get("stopped_by")
                names = (name for name in (*_NUMBERS, "machine") if name in event)
                numbers |= {name: event[name] for name in names}
        except (KeyError, TypeError, ValueError):  # of a damaged file
            continue
    return Course(tuple(training), tuple(evaluations), **numbers)


def course_of(folder: pathlib.Path) -> Course | None:
    """Summarize the events in a run folder.

    Args:
      folder: The run folder.

    Returns:
      The summary, or None if there are no events.
    """
    try:
        return course(event_log.read_events(folder))
    except ValueError:
        return None


_NUMBERS = ("step", "steps", "seconds", "compile_seconds")


def _row(event):
    at = {"step": int(event["step"]), "seconds": float(event["seconds"])}
    if "cpu_seconds" in event:  # not in runs of earlier versions
        at["cpu_seconds"] = _number(event["cpu_seconds"])
    return at | dict(event["metrics"])


def _until(rows, step):
    return [row for row in rows if row["step"] <= step]


def write(
    folder: pathlib.Path,
    history: History,
    frames: Sequence[str],
    logged: Course | None = None,
) -> None:
    """Write `curve.json`: evaluations, mean metrics of chunks, and the machine.

    Args:
      folder: Folder to write it to.
      history: History of the run, which is written if events were lost.
      frames: Names of the held-out frames of the evaluations.
      logged: Summary of the events of the run, which is written if it is complete.
    """
    logged = logged or Course()
    evaluations, training = logged.evaluations, logged.training
    if list(map(_key, evaluations)) != list(map(_key, history.evaluations)):
        evaluations, training = history.evaluations, history.rows
    write_json(
        folder / CURVE,
        {
            "evaluations": event_log.json_values(evaluations),
            "training": event_log.json_values(training),
            "frames": list(frames),
            "compile_seconds": history.compile_seconds,
            "machine": clock.machine(),
        },
    )


def _key(row):
    return row["hook"], row["step"]


def read(folder: pathlib.Path) -> Curve:
    """Read the curve of a run, which may still be running or may have been killed.

    Args:
      folder: The run folder.

    Returns:
      The curve, from `events.jsonl` until the run has ended, and from `curve.json`
      afterwards.

    Raises:
      ValueError: The folder has neither file, or it is damaged.
    """
    folder = pathlib.Path(folder)
    summary = course_of(folder)
    if not (folder / CURVE).is_file():
        if summary is None:
            raise ValueError(
                f"{folder}: neither {CURVE} nor {event_log.EVENTS} exists; pass a run "
                "folder. To create them for a run of an earlier version, resume it "
                "without further steps"
            )
        return _curve_of(summary)
    curve = _stored_curve(folder / CURVE)
    last_step = max(curve.steps, default=0)
    if summary is not None and not summary.ended and summary.step > last_step:
        return _curve_of(summary)
    return curve


def _curve_of(summary):
    # Rows of a damaged file may lack metrics.
    rows = [{"ssim": None, **row} for row in summary.evaluations if "psnr" in row]
    numbers = summary.compile_seconds, summary.machine
    return _curve(rows, summary.frames, *numbers)


def _curve(evaluations, frames, compile_seconds, machine):
    rows = of_held_out(evaluations)
    return Curve(
        seconds=tuple(float(row["seconds"]) for row in rows),
        steps=tuple(int(row["step"]) for row in rows),
        psnr=tuple(_number(row["psnr"]) for row in rows),
        ssim=tuple(_number(row["ssim"]) for row in rows),
        frames=tuple(frames),
        compile_seconds=float(compile_seconds),
        machine=dict(machine),
        cpu_seconds=tuple(_number(row.get("cpu_seconds")) for row in rows),
    )


def _stored_curve(path):
    try:
        content = read_json(path, dict[str, Any])
        names = ("evaluations", "frames", "compile_seconds", "machine")
        return _curve(*(content[name] for name in names))
    except FileError:  # it names the path already
        raise
    except UNEXPECTED_CONTENT as error:
        raise FileError(f"{path}: not a valid curve of a run ({error!r})") from error


def _number(value):
    return math.nan if value is None else float(value)


def seconds_to(curve: Curve, psnr: float | int) -> float | None:
    """Find the seconds of training after which the curve stays at or above a PSNR.

    Args:
      curve: The curve.
      psnr: PSNR in dB.

    Returns:
      Seconds, linearly interpolated between evaluations, or None if the curve ends
      below.
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
    start, end = curve.seconds[last - 1], curve.seconds[last]
    return start + share * (end - start)
