"""Runs of `nerfies reconstruct` in processes of their own, several at a time."""

import json
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from experiments import records
from experiments.benchmark import suites
from nerfies_jax.runs import run_folder
from nerfies_jax.runtime import children, stopping

ROOT = pathlib.Path(__file__).resolve().parents[2]  # where `experiments` is imported
POLL_SECONDS = 0.1
PATIENCE_SECONDS = 60.0  # for a run to save its state before it is killed
COMPLETE = {"heldout.psnr": object}  # entries of the metrics of a finished run


class Run(NamedTuple):
    """One run: a method and a seed."""

    method: str
    seed: int
    folder: pathlib.Path
    words: tuple[str, ...]  # options of `nerfies reconstruct`
    seconds: float | None  # of training; None for the steps of the preset

    @property
    def name(self) -> str:
        """The run in a message."""
        return f"{self.method}, seed {self.seed}"

    @property
    def log(self) -> pathlib.Path:
        """File of all that the run prints."""
        return self.folder.with_name(f"{self.folder.name}.log")


class Result(NamedTuple):
    """Result of a finished run."""

    preset: str
    metrics: dict[str, float]
    machine: dict[str, Any]


def words(
    source: Sequence[str], settings: str, seed: int, steps: int | None
) -> tuple[str, ...]:
    """Assemble the options of `nerfies reconstruct`.

    Args:
      source: Options that name the capture.
      settings: Preset and changes of the method.
      seed: The seed.
      steps: Number of steps, None for the preset's own.

    Returns:
      The options, without the folder.
    """
    preset, changes = suites.parsed(settings)
    options = [*source, "--seed", str(seed)]
    options += [] if preset is None else ["--preset", preset]
    options += [] if steps is None else ["--steps", str(steps)]
    return (*options, *(["--set", *changes] if changes else ()))


def result(run: Run) -> Result | None:
    """Read the result of a run.

    Args:
      run: The run.

    Returns:
      The result, None if the run is not finished.
    """
    from nerfies_jax.runs import curves

    metrics = records.one(run.folder / "metrics.json", COMPLETE)
    if metrics is None:
        return None
    config = json.loads((run.folder / run_folder.CONFIG).read_text())["config"]
    known = {key: value for key, value in metrics.items() if value is not None}
    return Result(config["preset"], known, curves.read(run.folder).machine)


def execute(runs: Iterable[Run], jobs: int) -> Iterator[tuple[Run, int]]:
    """Execute runs, and continue those that were interrupted.

    A signal to this process ends all of them, and each saves its state first.

    Args:
      runs: The runs.
      jobs: Number of runs at a time.

    Yields:
      Each run that has ended, with its exit code.
    """
    waiting = list(runs)
    running: dict[Run, subprocess.Popen] = {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                run = waiting.pop(0)
                running[run] = _start(run, alone=jobs == 1)
            for run in list(running):
                if running[run].poll() is not None:
                    yield run, running.pop(run).returncode
            time.sleep(POLL_SECONDS)
            stopping.check()
    finally:
        with stopping.protected():
            _end(running.values())


def _start(run, alone):
    run.folder.parent.mkdir(parents=True, exist_ok=True)
    options = [*run.words, "--out", str(run.folder)]
    if (run.folder / run_folder.CONFIG).exists():
        options.append("--resume")
    elif run.seconds is not None:
        options += ["--seconds", f"{run.seconds:g}"]
    path = filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path), "COLUMNS": "88"}
    if not alone:
        environment |= {"PJRT_NPROC": "1", "JAX_NUM_CPU_DEVICES": "1"}
    with run.log.open("w") as file:
        return children.start(
            [sys.executable, "-P", "-m", "experiments.reconstruct", *options],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
            # Ctrl-C reaches this process alone, which passes it on once.
            start_new_session=True,
        )


def _end(processes):
    """End processes, and kill those that do not end in time."""
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + PATIENCE_SECONDS
    for process in processes:
        try:
            process.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def last_line(run: Run) -> str:
    """Return the last line that a run printed.

    Args:
      run: The run.

    Returns:
      The line, empty if there is none.
    """
    lines = run.log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""
