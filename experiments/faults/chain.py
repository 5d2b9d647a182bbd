"""A job that is disturbed several times, and compared with one that never was."""

import json
import os
import pathlib
import random
import shutil
import time
from typing import Any, NamedTuple

from experiments.faults import inject, jobs
from nerfies_jax.runtime import children

FAULTS = 5  # of a chain
LATEST = 0.9  # share of the processor time at which a fault happens
RESUMED = 0.7  # of the time of a whole job, where it goes on


class Reference(NamedTuple):
    """A job that was never disturbed."""

    name: str
    result: dict[str, str]
    processor_seconds: float


def reference(bench: jobs.Bench, name: str) -> Reference:
    """Run a job without a fault, or take it from an earlier campaign.

    Raises:
      ValueError: It fails, or a second run of it has other bits.
    """
    from nerfies_jax.capture.json_files import write_json  # imports JAX

    job = jobs.JOBS[name]
    kept = bench.folder / "references" / f"{name}.json"
    if kept.exists():
        return Reference(*json.loads(kept.read_text()))
    results = []
    for number in range(2):  # the second time with the caches of the first
        work = bench.folder / "references" / (name if number == 0 else f"{name}-2")
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        job.before(bench, work)
        done = _undisturbed(bench, job, work)
        if done is None or done.code:
            said = "" if done is None else done.said[-2000:]
            raise ValueError(f"{name} fails without any fault: {said}")
        seconds = done.processor_seconds
        results.append(job.result(work))
    if results[0] != results[1]:
        raise ValueError(f"{name}: {_difference(*results)} without any fault")
    shutil.rmtree(work)
    found = Reference(name, results[0], seconds)
    write_json(kept, list(found))
    return found


class _Done(NamedTuple):
    """A process that ended without a fault."""

    code: int
    said: str
    processor_seconds: float  # of its children, too


def _undisturbed(bench, job, work):
    """Run a job to its end, and return its error or None."""
    command = job.command(bench, work)
    if command is None:
        return None
    log = work.with_name(f"{work.name}.log")
    with log.open("wb") as file:
        process = children.start(
            command, cwd=work, env=bench.environment, stdout=file, stderr=file
        )
        _, status, used = os.wait4(process.pid, 0)
    process.returncode = code = os.waitstatus_to_exitcode(status)
    said = log.read_text(errors="replace")
    return _Done(code, said, used.ru_utime + used.ru_stime)


def run(
    bench: jobs.Bench,
    known: Reference,
    name: str,
    only: str | None,
    disk: pathlib.Path | None,
) -> list[dict[str, Any]]:
    """Disturb a job several times, continue it to its end, and compare.

    Args:
      bench: The campaign.
      known: The job without a fault.
      name: Of the chain. It draws the faults and their moments.
      only: The kind of faults, all where None.
      disk: The library of `inject.compiled_disk`. Without it no disk fails.

    Returns:
      One row for each fault.
    """
    job, draw = jobs.JOBS[known.name], random.Random(name)
    work = bench.work / f"{known.name}-{name}"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    job.before(bench, work)
    rows: list[dict[str, Any]] = []
    while len(rows) < FAULTS:
        command = job.command(bench, work)
        if command is None or (rows and _ran_through(rows[-1])):
            break
        kind = (
            only
            or draw.choices(
                list(inject.KINDS), (4, 4, 1, 2 if disk is not None else 0)
            )[0]
        )
        fault, share = draw.choice(inject.KINDS[kind]), draw.uniform(0, LATEST)
        share *= RESUMED if rows else 1
        whole, began = job.whole(work), time.monotonic()
        after = share * known.processor_seconds
        ended = inject.disturbed(command, work, bench.environment, fault, after, disk)
        row = {
            "job": known.name,
            "kind": kind,
            "fault": fault,
            "share": round(share, 3),
            "happened": ended.happened,
            "code": ended.code,
            "seconds": round(time.monotonic() - began, 1),
            "lost": ended.problem or _damage(job, work, whole, known),
        }
        rows.append(row)
        if row["lost"]:
            _keep(work, ended.said)
            return [each for each in rows if each["happened"] or each["lost"]]
    problem = _finish(bench, job, work, known, rows)
    rows = [row for row in rows if row["happened"]]
    if problem and rows:
        rows[-1]["lost"] = problem
    if not problem:
        shutil.rmtree(work)
    return rows


def _ran_through(row):
    return row["code"] == 0 or row["kind"] == "pipe"


def _keep(work, said):
    """The output of a process that lost something, next to its folder."""
    work.with_name(f"{work.name}.lost.txt").write_text(said)


def _damage(job, work, before, known):
    """Describe damage to an earlier result, which the final one may replace."""
    after = job.whole(work)
    if after == known.result or all(after.get(k) == x for k, x in before.items()):
        return ""
    return f"an earlier result: {_difference(before, after)}"


def _finish(bench, job, work, known, rows):
    """Continue a job to its end, and describe its errors."""
    if not rows or not _is_same(job, work, known) or jobs.litter(work):
        done = _undisturbed(bench, job, work)
        if done is not None and done.code:
            _keep(work, done.said)
            return f"it cannot be continued (exit code {done.code})"
    try:
        result = job.result(work)
    except (OSError, ValueError, KeyError) as error:
        return f"no result: {error}"
    if result != known.result:
        return _difference(known.result, result)
    left = jobs.litter(work)
    return f"left behind: {', '.join(left)}" if left else ""


def _is_same(job, work, known):
    try:
        return job.result(work) == known.result
    except (OSError, ValueError, KeyError):
        return False


def _difference(one, other):
    names = sorted(k for k in {*one, *other} if one.get(k) != other.get(k))
    return f"other bits in {', '.join(names[:5])}" + (" ..." if names[5:] else "")


def line(row: dict[str, Any]) -> str:
    """A row for a person."""
    text = (
        f"{row['job']}: {row['fault']} at {row['share']:.0%}, exit code {row['code']} "
        f"after {row['seconds']:.0f} s"
    )
    return f"{text}, LOST: {row['lost']}" if row["lost"] else text
