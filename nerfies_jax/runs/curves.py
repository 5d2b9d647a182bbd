"""Losses and metrics of a run over time, from its events.

`events.jsonl` has them while the run goes on, and `curve.json` holds a summary once it
has ended.
"""

import math
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from nerfies_jax.capture.errors import FileError
from nerfies_jax.capture.json_files import read_json, write_json
from nerfies_jax.metrics import clock
from nerfies_jax.runs import event_log
from nerfies_jax.runtime.events import Event
from nerfies_jax.training.loop import History

CURVE = "curve.json"


class Curve(NamedTuple):
    """Quality over the time of training, with one entry for each evaluation."""

    seconds: tuple[float, ...]  # of training, without compiling
    steps: tuple[int, ...]
    psnr: tuple[float, ...]  # dB, mean of a few held-out frames
    ssim: tuple[float, ...]
    frames: tuple[str, ...]  # names of those frames
    compile_seconds: float
    machine: dict[str, Any]


class Course(NamedTuple):
    """Training of a run so far, from its events.

    Rows are dictionaries with `step`, `seconds` of training and the metrics, in the
    order of steps. If a resumed run repeated steps, the last ones count.
    """

    training: tuple[dict[str, Any], ...] = ()  # mean metrics of chunks, thinned out
    evaluations: tuple[dict[str, Any], ...] = ()  # with `hook` as well
    frames: tuple[str, ...] = ()  # held-out frames that evaluations are of
    step: int = 0  # completed
    steps: int | None = None  # asked for
    seconds: float = 0.0  # of training
    compile_seconds: float = 0.0
    stopped_by: str | None = None  # None while it runs, and where it was killed
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
        words = f"step {self.step:,}"
        if self.steps is not None:
            words += f" of {self.steps:,}"
        scores = [row["psnr"] for row in self.evaluations if row.get("psnr")]
        if scores:
            words += f", {scores[-1]:.2f} dB over the {len(self.frames)} frames of its "
            words += "curve"
        return words


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
                    # Everything after the checkpoint is repeated.
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
    return at | dict(event["metrics"])


def _until(rows, step):
    return [row for row in rows if row["step"] <= step]


def write(
    folder: pathlib.Path,
    history: History,
    frames: Sequence[str],
    told: Course | None = None,
) -> None:
    """Write `curve.json`: evaluations, mean metrics of chunks, and the machine.

    Args:
      folder: Folder to write it to.
      history: History of the run, which replaces events that were lost.
      frames: Names of the held-out frames of the evaluations.
      told: Summary of the events of the run, which is written if it is complete.
    """
    told = told or Course()
    evaluations, training = told.evaluations, told.training
    if [_at(row) for row in evaluations] != [_at(row) for row in history.evaluations]:
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


def _at(row):
    return row["hook"], row["step"]


def read(folder: pathlib.Path) -> Curve:
    """Read the curve of a run, also of one that is running or was killed.

    Args:
      folder: The run folder.

    Returns:
      The curve, by `events.jsonl` as long as the run has not ended, by `curve.json`
      afterwards.

    Raises:
      ValueError: The folder has neither file, or it is damaged.
    """
    folder = pathlib.Path(folder)
    told = course_of(folder)
    if not (folder / CURVE).is_file():
        if told is None:
            raise ValueError(
                f"{folder}: neither {CURVE} nor {event_log.EVENTS} here; name the "
                "folder of a run. One from before there were these files can be "
                "resumed for no further steps to get them"
            )
        return _curve_of(told)
    stored = _stored(folder / CURVE)
    if told is not None and not told.ended and told.step > max(stored.steps, default=0):
        return _curve_of(told)
    return stored


def _curve_of(told):
    rows = [row for row in told.evaluations if "psnr" in row]
    return Curve(
        seconds=tuple(row["seconds"] for row in rows),
        steps=tuple(row["step"] for row in rows),
        psnr=tuple(_number(row["psnr"]) for row in rows),
        ssim=tuple(_number(row.get("ssim")) for row in rows),
        frames=told.frames,
        compile_seconds=told.compile_seconds,
        machine=told.machine,
    )


def _stored(path):
    try:
        stored = read_json(path, dict[str, Any])
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
    except FileError:  # it names the path already
        raise
    except (
        LookupError,
        TypeError,
        AttributeError,
        ValueError,
        ArithmeticError,
    ) as error:
        raise FileError(f"{path}: not the curve of a run ({error!r})") from error


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
    began, ended = curve.seconds[last - 1], curve.seconds[last]
    return began + share * (ended - began)
