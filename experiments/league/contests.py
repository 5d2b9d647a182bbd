"""The parts of a league, one film and length of training each, as ablations."""

import copy
import dataclasses
import hashlib
import itertools
import json
import math
import pathlib
import time
from typing import Any

from experiments import asked
from experiments import kept as kept_files
from experiments.ablate import pool, results
from experiments.ablate.job import Job
from experiments.ablate.log import log
from experiments.ablate.results import ArmResult
from experiments.league import rows
from experiments.league.settings import League
from nerfies_jax.capture.json_files import write_json
from nerfies_jax.evaluation import protocol
from nerfies_jax.measure import clock

# What a film may tell beside pictures, cameras and points, and most rows do not read.
TOLD = {"depths", "flow", "moving"}


def opened(args: League, arms: tuple[str, ...]) -> list[Job]:
    """A job for each length and film, the short ones of all films first."""
    return [
        Job(args.ablation(name, seconds, arms))
        for seconds in args.limits
        for name in args.sources
    ]


def run(args: League, jobs: list[Job]) -> list[tuple[str, int]]:
    """Make what is not there, seed by seed over all jobs; returns what failed."""
    began, failed = time.monotonic(), []
    for seed in range(args.seeds):
        for job in jobs:
            one = _of_seed(job, seed)
            if args.budget is not None:
                left = args.budget - (time.monotonic() - began) / 60
                one.args = dataclasses.replace(job.args, budget=left)
            if not all(one.is_finished(*task) for task in one.tasks()):
                log(f"{job.capture.name}, {job.budgets[0].title}, seed {seed}:")
                failed += pool.run(one)
    return failed


def _of_seed(job, seed):
    """The cells of one seed; over seconds, seed 0 finds the steps of the others."""
    one = copy.copy(job)
    one.seeds = (seed,)
    if seed and job.args.seconds is not None:
        one.names = tuple(name for name in job.names if job.is_finished(name, 0))
    return one


def restore(before: dict[str, Any], jobs: list[Job]) -> int:
    """Put kept cells into the folders of the parts; returns how many.

    Those that were made with the settings of today alone, and that are not there yet:
    whatever has changed since is measured anew. No pictures come with them.
    """
    count = 0
    for job, one in itertools.product(jobs, before.get("contests", ())):
        if _key(one) != (job.out.name, job.args.seconds):
            continue
        for name, seed in job.tasks():
            row = one["rows"].get(name, {"cells": {}})
            cell = row["cells"].get(str(seed))
            place = job.path(name, seed, job.budgets[0])
            if cell is None or results.is_there(place):
                continue
            # The first seed here may have found other steps for all of them.
            first = results.steps_of(job.budgets[0].folder, name)
            if seed and job.args.seconds is not None and first != row["steps"]:
                continue
            identity = job.identity(name, seed, row["steps"], job.budgets[0])
            if row["made_with"] == _made_with(identity):
                numbers = results.read_numbers(cell["numbers"])
                notes = {key: cell[key] for key in ("stopped_by", "cpu", "revision")}
                notes["steps"] = int(numbers["steps"])
                results.write(place, identity, ArmResult(numbers, {}, notes))
                count += 1
    return count


def without(
    before: dict[str, Any], names: tuple[str, ...], jobs: list[Job]
) -> dict[str, Any]:
    """What is kept but for the cells of some rows, whose steps stay settled.

    Another day's seconds are worth other steps: made anew, a row stands beside the
    others over as many as they were given. ValueError for rows that are not asked for.
    """
    left = copy.deepcopy(before)
    for name in names:
        if not any(name in job.names for job in jobs):
            raise ValueError(f"--anew {name}: is not among the rows that are asked for")
    for job, one in itertools.product(jobs, left.get("contests", ())):
        if _key(one) != (job.out.name, job.args.seconds):
            continue
        rows_of = {n: one["rows"][n] for n in names if n in one["rows"]}
        for row in rows_of.values():
            row["cells"] = {}
        if job.args.seconds is not None:
            steps = {n: row["steps"] for n, row in rows_of.items() if row["steps"]}
            results.settle_steps(job.budgets[0].folder, steps)
    return left


def _made_with(identity):
    """Equal where two seeds of a row may stand side by side."""
    return _digest({k: x for k, x in identity.items() if k != "seed"})


def _digest(settings):
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def record(args: League, jobs: list[Job]) -> dict[str, Any]:
    """What is kept: the numbers of every finished cell, and which were asked for."""
    machine = clock.machine()
    return {
        "machine": machine,
        "settings": asked.without_places(args),
        "contests": [_contest(job, machine["cpu"]) for job in jobs],
    }


def merged(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """What is kept, with the films, rows and seeds of `before` that `now` has not.

    ValueError where cells of `before` would go that `now` has not made anew: those of
    other settings, which cannot stand beside what there is now.
    """
    contests, lost = [copy.deepcopy(one) for one in now["contests"]], []
    known = rows.suite().arms
    for old in before.get("contests", ()):
        key = _key(old)
        same = [one for one in contests if _key(one) == key]
        if not same:
            contests.append(old)
            continue
        (one,) = same
        for name, row in old["rows"].items():
            alike = one["measured_on"] == old["measured_on"]
            if not row["cells"] and name not in known:  # a row of former days
                continue
            if alike and name not in one["rows"]:
                one["rows"][name] = row
                continue
            mine = one["rows"].get(name, {"cells": {}, "made_with": None})
            left = {s: x for s, x in row["cells"].items() if s not in mine["cells"]}
            if row["made_with"] == mine["made_with"]:
                mine["cells"] |= left
            else:
                lost += [f"{name} (seed {seed})" for seed in left]
        one["seeds"] = sorted({*one["seeds"], *old["seeds"]})
    if lost:
        raise ValueError(
            f"{len(lost)} kept cells, {lost[0]} first, were made with other settings "
            "and not made anew: what is kept stays as it is; go on with the same "
            "command, or remove the kept file"
        )
    # In the order in which they were: pages would change where no number did.
    place = {_key(one): n for n, one in enumerate(before.get("contests", ()))}
    contests.sort(key=lambda one: place.get(_key(one), len(place)))
    machine = clock.beside(now["machine"], before.get("machine", {}))
    return now | {"machine": machine, "contests": contests}


def _key(contest):
    return contest["film"], contest["seconds"]


def kept(path: pathlib.Path) -> dict[str, Any]:
    """What `write` wrote; empty where it wrote nothing yet."""
    return kept_files.rows(path, contests=list)


def _contest(job, cpu):
    still = protocol.static_error(job.known)
    finished = job.finished(job.budgets[0])
    return {
        "film": job.out.name,
        "seconds": job.args.seconds,
        "exact": job.known.exact,
        "still": still if math.isfinite(still) else None,
        "measured_on": _digest(job.measured_on()),
        "seeds": list(job.seeds),
        "rows": {name: _row(job, name, finished, cpu) for name in job.names},
    }


def _row(job, name, finished, cpu):
    arm, budget = job.suite.arms[name], job.budgets[0]
    cells = {s: finished[name, s] for s in job.seeds if (name, s) in finished}
    steps = made_with = None
    if cells:
        steps = job.planned_steps(name, budget)
        made_with = _made_with(job.identity(name, 0, steps, budget))
    return {
        "preset": arm.preset,
        "changes": list(arm.changes),
        "reads": sorted(job.required_data(name) & TOLD),
        "steps": steps,
        "made_with": made_with,
        "cells": {str(seed): _cell(cell, cpu) for seed, cell in cells.items()},
    }


def _cell(kept, cpu):
    return {
        "numbers": results.stored_numbers(kept.numbers),
        "stopped_by": kept.notes["stopped_by"],
        "cpu": kept.notes.get("cpu", cpu),  # of one that was restored
        "revision": kept.notes["revision"],
    }


def write(path: pathlib.Path, stored: dict[str, Any]) -> None:
    """As JSON, whole or not at all."""
    write_json(path, stored)
