"""Arms of an ablation at once: one process with one core for each."""

import contextlib
import dataclasses
import os
import pathlib
import subprocess
import sys
import time
from typing import NamedTuple

from experiments.ablate.log import line, log
from nerfies_jax.capture.json_files import probe, write_json
from nerfies_jax.runtime import children, stopping
from nerfies_jax.training import specs

ROOT = pathlib.Path(__file__).resolve().parents[2]  # where `experiments` is imported
POLL_SECONDS = 0.1
PATIENCE_SECONDS = 30.0  # for a process to end by itself before it is killed


class Running(NamedTuple):
    """A process that makes one arm and seed."""

    process: subprocess.Popen
    began: float
    log: pathlib.Path  # all that it prints


def run(job) -> list[tuple[str, int]]:
    """Train what is not finished, in `--jobs` processes.

    Every process runs `experiments.ablate.worker` for one run and writes its own files.
    Ctrl-C and SIGTERM end them all. A failing run is reported, and the others continue.

    Returns:
      Methods and seeds that failed.
    """
    every = job.tasks()
    waiting = [task for task in every if not job.is_finished(*task)]
    running: dict[tuple[str, int], Running] = {}
    failed: list[tuple[str, int]] = []
    began, longest = time.monotonic(), 0.0
    with _ended_by_signals():
        try:
            while waiting or running:
                spent = time.monotonic() - began
                if waiting and job.is_over(spent, longest):
                    waiting = []
                _skip_orphans(job, waiting, failed)
                task = _next(job, waiting, running)
                if task is not None and len(running) < job.args.jobs:
                    waiting.remove(task)
                    running[task] = start(job, *task)
                    number = every.index(task) + 1
                    log(f"[{number}/{len(every)}] {_name(task)}, after {spent:.0f} s")
                    continue
                for task in [
                    t for t in running if running[t].process.poll() is not None
                ]:
                    ended = running.pop(task)
                    longest = max(longest, time.monotonic() - ended.began)
                    if not _is_well(job, task, ended):
                        failed.append(task)
                time.sleep(POLL_SECONDS)
                stopping.check()
        finally:
            with stopping.protected():
                _stop(running)
    return failed


def start(job, name: str, seed: int) -> Running:
    """A process for one arm and seed, with all it prints in a file of its own."""
    log_path = job.out / "logs" / f"{name}-{seed}.txt"
    log_path.parent.mkdir(exist_ok=True)
    path = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {
        "PJRT_NPROC": "1",
        "PYTHONPATH": os.pathsep.join(path),
        "COLUMNS": "88",
    }
    with log_path.open("w") as file:
        process = children.start(
            command(job, name, seed),
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
            # Ctrl-C reaches this process alone, which passes it on once.
            start_new_session=True,
        )
    return Running(process, time.monotonic(), log_path)


def command(job, name: str, seed: int) -> list[str]:
    """A process that makes one arm and seed, as its settings file says."""
    path = job.out / "logs" / f"{name}-{seed}.json"
    one = dataclasses.replace(
        job.args, arms=(name,), seed=seed, jobs=1, budget=None, out=job.out
    )
    write_json(path, specs.as_json(one))
    return [sys.executable, "-m", "experiments.ablate.worker", str(path)]


def _next(job, waiting, running):
    """The first that may begin: over seconds, seed 0 finds the steps of all seeds."""
    for name, seed in waiting:
        if job.args.seconds is None or seed == 0 or job.is_finished(name, 0):
            return name, seed
    return None


def _skip_orphans(job, waiting, failed):
    """Over seconds, what waits for a first seed that failed can never begin."""
    if job.args.seconds is None:
        return
    for task in [t for t in waiting if (t[0], 0) in failed]:
        log(f"{_name(task)}: not begun, seed 0 failed and finds its steps")
        waiting.remove(task)
        failed.append(task)


def _is_well(job, task, ended):
    name, seed = task
    took = time.monotonic() - ended.began
    code = ended.process.returncode
    if code == 0 and job.is_finished(name, seed):
        kept = job.kept(name, seed, job.budgets[-1])
        log(f"    {_name(task)}: {line(kept.numbers)}; {took:.0f} s in all")
        return True
    reason = f"exit code {code}" if code else "made by another process, not yet there"
    last = ended.log.read_text(errors="replace").strip().splitlines()[-1:]
    log(f"    {_name(task)} failed ({reason}); {ended.log} ends with: {''.join(last)}")
    try:
        probe(job.out)
    except OSError as error:  # its log could not be written either
        log(f"    {job.out} cannot be written ({error.strerror})")
    return False


def _name(task):
    return f"{task[0]}, seed {task[1]}"


@contextlib.contextmanager
def _ended_by_signals():
    """Ctrl-C, SIGTERM and SIGHUP leave the block with exit code 128 + number."""
    try:
        with stopping.exits():
            yield
    except KeyboardInterrupt:
        log("stopped; the same command goes on")
        raise SystemExit(130) from None
    except stopping.Stopped:
        log("stopped; the same command goes on")
        raise


def _stop(running):
    """End the running processes, which leave no partial files."""
    for one in running.values():
        one.process.terminate()
    deadline = time.monotonic() + PATIENCE_SECONDS
    for one in running.values():
        try:
            one.process.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            one.process.kill()
            one.process.wait()
