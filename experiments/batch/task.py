"""A run of `nerfies reconstruct` in a process of its own, within limits."""

import contextlib
import dataclasses
import json
import math
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import filelock
import psutil

from experiments import records
from nerfies_jax.runs import run_folder
from nerfies_jax.runtime import children

ROOT = pathlib.Path(__file__).resolve().parents[2]  # where `experiments` is imported
POLL_SECONDS = 0.1
MEMORY_SECONDS = 0.5  # between two measurements of memory
PATIENCE_SECONDS = 60.0  # for a run to save its state before it is killed
COMPLETE = {"heldout.psnr": object}  # entries of the metrics of a finished run
# Exit codes of runs that a signal ended after they had saved their state.
SIGNALED = frozenset(128 + getattr(signal, name, 15) for name in ("SIGTERM", "SIGHUP"))

_running: set[subprocess.Popen] = set()  # runs that this process supervises


class Result(NamedTuple):
    """Result of a finished run."""

    preset: str
    metrics: dict[str, float]
    machine: dict[str, Any]
    curve: Any  # a `runs.curves.Curve`, whose module loads JAX
    settings: dict[str, Any]  # contents of its config.json


class Ending(NamedTuple):
    """End of a process."""

    code: int  # exit code, negative for a signal
    reason: str  # last line of its log, or the limit that it exceeded
    interrupted: bool = False  # by a signal from outside, so that it can be continued


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of one process."""

    memory_bytes: float = math.inf  # of the process and its children
    seconds: float = math.inf


@dataclasses.dataclass(frozen=True)
class Task:
    """One run, which continues if its folder holds an interrupted one.

    Calling it executes the run. It can be pickled, and its paths are absolute, so that
    any process that sees the same files can execute it.
    """

    name: str  # in messages
    folder: pathlib.Path
    words: tuple[str, ...]  # options of `nerfies reconstruct` without the folder
    seconds: float | None = None  # of training; None for the steps of the preset
    one_core: bool = False  # the machine is shared with other runs
    limits: Limits = Limits()
    # Options of `nerfies prepare` that end with the capture, for a video.
    prepare: tuple[str, ...] = ()

    @property
    def log(self) -> pathlib.Path:
        """File of all that the run prints."""
        return self.folder.with_name(f"{self.folder.name}.log")

    def __call__(self, stop: threading.Event | None = None) -> Ending:
        """Execute the run.

        Args:
          stop: Event that ends it. The run saves its state first.

        Returns:
          How it ended.
        """
        stop = threading.Event() if stop is None else stop
        deadline = time.monotonic() + self.limits.seconds
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        ending = self._prepare(deadline, stop)
        if ending.code:
            return ending
        words = [*self.words, "--out", str(self.folder)]
        if (self.folder / run_folder.CONFIG).exists():
            words.append("--resume")
        elif self.seconds is not None:
            words += ["--seconds", f"{self.seconds:g}"]
        return self._supervise(["reconstruct", *words], deadline, stop)

    def checkpoint(self) -> Any:
        """Save the state when Slurm preempts the job. Called by submitit.

        Returns:
          The submission that continues the run.
        """
        import submitit

        with contextlib.suppress(psutil.NoSuchProcess):
            # Not `Popen.wait`: this handler may have interrupted it.
            processes = [psutil.Process(each.pid) for each in _running]
            for process in processes:
                process.terminate()
            psutil.wait_procs(processes, PATIENCE_SECONDS)
        return submitit.helpers.DelayedSubmission(self)

    def _prepare(self, deadline, stop):
        """Convert the video of several runs to a capture once."""
        if not self.prepare:
            return Ending(0, "")
        capture = pathlib.Path(self.prepare[-1])
        with filelock.FileLock(f"{capture}.lock"):
            if (capture / run_folder.PREPARED).is_file():
                return Ending(0, "")
            return self._supervise(["prepare", *self.prepare], deadline, stop)

    def _supervise(self, words, deadline, stop):
        """Run a command of this package until it ends or exceeds a limit."""
        process = self._start(words)
        _running.add(process)
        next_look = time.monotonic()
        try:
            while True:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    return self._ending(process.wait(POLL_SECONDS))
                now = time.monotonic()
                if stop.is_set():
                    return self._ending(_end(process))
                if now > deadline:
                    limit = f"time limit of {self.limits.seconds:g} s"
                    return Ending(_end(process) or 1, f"stopped at the {limit}")
                if now < next_look or math.isinf(self.limits.memory_bytes):
                    continue
                next_look = now + MEMORY_SECONDS
                memory_bytes = _memory(process)
                if memory_bytes > self.limits.memory_bytes:
                    # Saving could take more memory. The last checkpoint stays.
                    process.kill()
                    limit = f"limit of {self.limits.memory_bytes / 1e9:.3g} GB"
                    reason = (
                        f"used {memory_bytes / 1e9:.3g} GB, above the memory {limit}"
                    )
                    return Ending(process.wait(), reason)
        finally:
            _end(process)
            _running.discard(process)

    def command(self, words: Sequence[str]) -> list[str]:
        """Return the program of a command of this package and its arguments."""
        return [sys.executable, "-P", "-m", f"experiments.{words[0]}", *words[1:]]

    def _start(self, words):
        path = filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(path),
            "COLUMNS": "88",
        }
        if self.one_core:
            environment |= {"PJRT_NPROC": "1", "JAX_NUM_CPU_DEVICES": "1"}
        with self.log.open("a") as file:
            return children.start(
                self.command(words),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                # Ctrl-C reaches the supervisor alone, which passes it on once.
                start_new_session=True,
            )

    def _ending(self, code):
        if code < 0:
            reason = f"killed by {signal.Signals(-code).name}"
            return Ending(code, reason, interrupted=True)
        reason = "" if code == 0 else last_line(self.log)
        return Ending(code, reason, code in SIGNALED)


def options(
    source: Sequence[str],
    preset: str | None,
    changes: Sequence[str],
    seed: int,
    steps: int | None,
    evaluate_at: Sequence[int] = (),
) -> tuple[str, ...]:
    """Assemble the options of `nerfies reconstruct`, without the folder.

    Args:
      source: Options that name the capture.
      preset: The preset, None for the default.
      changes: Changes of its fields.
      seed: The seed.
      steps: Number of steps, None for the preset's own.
      evaluate_at: Steps of the points of its curve, empty for those of the default.

    Returns:
      The options.
    """
    words = [*source, "--seed", str(seed)]
    words += [] if preset is None else ["--preset", preset]
    words += [] if steps is None else ["--steps", str(steps)]
    words += ["--evaluate-at", *map(str, evaluate_at)] if evaluate_at else []
    return (*words, *(["--set", *changes] if changes else ()))


def result(task: Task) -> Result | None:
    """Read the result of a run.

    Args:
      task: The run.

    Returns:
      The result, None if the run is not finished.
    """
    from nerfies_jax.runs import curves

    metrics = records.one(task.folder / "metrics.json", COMPLETE)
    if metrics is None:
        return None
    settings = json.loads((task.folder / run_folder.CONFIG).read_text())
    values = {key: value for key, value in metrics.items() if value is not None}
    curve = curves.read(task.folder)
    preset = settings["config"]["preset"]
    return Result(preset, values, curve.machine, curve, settings)


def summary(metrics: Mapping[str, float]) -> str:
    """Summarize the metrics of a run in a few words."""
    moving = metrics.get("heldout.moving_psnr")
    words = [f"{metrics['heldout.psnr']:.2f} dB"]
    words += [f"{moving:.2f} dB in dynamic regions"] if moving is not None else []
    return ", ".join([*words, f"{metrics['train.seconds']:.0f} s"])


def failure(task: Task, ending: Ending) -> str:
    """Describe how a run failed, with the file of its log."""
    return (
        f"{task.name}: failed with exit code {ending.code}: {ending.reason} "
        f"({display_path(task.log)})"
    )


def display_path(path: pathlib.Path, base: pathlib.Path | None = None) -> str:
    """Return a path relative to a folder, by default the current one, that contains it.

    Args:
      path: An absolute path.
      base: The folder.

    Returns:
      The relative path, or the path itself where it is elsewhere.
    """
    base = pathlib.Path.cwd() if base is None else base.absolute()
    return str(path.relative_to(base) if path.is_relative_to(base) else path)


def last_line(log: pathlib.Path) -> str:
    """Return the last line of a log, empty if there is none."""
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


def _end(process):
    """End a process, and kill it if it does not end in time.

    Returns:
      Its exit code.
    """
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(PATIENCE_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
    return process.wait()


def _memory(process):
    """Bytes of memory of a process and its children."""
    total = 0
    with contextlib.suppress(psutil.Error):
        parent = psutil.Process(process.pid)
        for each in (parent, *parent.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                total += each.memory_info().rss
    return total
