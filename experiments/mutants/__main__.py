"""Mutation tests: random faults in both packages, and the tests that detect them.

    nerfies study mutants
    nerfies study mutants --count 12 --seed 3 --only gaussians_jax/raster

A copy of the checkout gets one fault at a time (an operator, a sign, a comparison, a
number, two swapped arguments, in some function body, with modules in turn), and the
default tests of the files that enter the function run until three fail. A run without
faults tells which files these are. Code that only child processes enter is not
detected. Most of the library's past faults were of these kinds.
"""

import concurrent.futures
import dataclasses
import hashlib
import pathlib
import queue
import subprocess
import tempfile

from experiments import cli, records
from experiments.mutants.faults import ROOT, sample_faults
from experiments.mutants.page import page
from experiments.mutants.witnesses import default_tests, reached_by, try_fault
from nerfies_jax.runtime import console


@dataclasses.dataclass(frozen=True)
class Mutants:
    """Plant faults and see which tests fail."""

    count: int = 60
    """Faults."""
    seed: int = 0
    """Seed of their places."""
    only: str = ""
    """Only in files whose path begins so."""
    jobs: int = 2
    """Faults tried at the same time."""
    minutes: float = 10.0
    """After which a run of tests that does not end counts as failed."""
    out: pathlib.Path = pathlib.Path("mutants.json")
    """File of the results. Results of the same seed in it are continued."""

    def __post_init__(self):
        for name in ("count", "jobs"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} {getattr(self, name)} must be at least 1")
        if self.minutes <= 0:
            raise ValueError(f"--minutes {self.minutes} must be above 0")


@cli.command(Mutants)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    with cli.user_errors():
        faults = sample_faults(args.count, args.seed, args.only)
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.metrics import clock

    rows = _stored_rows(args.out, args.seed)
    remaining = [
        fault for fault in faults if not any(_is_row_of(fault, r) for r in rows)
    ]
    copies = queue.SimpleQueue()
    with (
        tempfile.TemporaryDirectory() as folder,
        concurrent.futures.ThreadPoolExecutor(args.jobs) as workers,
    ):
        for job in range(args.jobs):
            copies.put(_copy(pathlib.Path(folder) / str(job)))

        def with_copy(call):
            copy = copies.get()
            try:
                return call(copy)
            finally:
                copies.put(copy)

        places_by_test = _reach(args.out, workers, with_copy)
        seconds = 60 * args.minutes
        tries = workers.map(
            lambda fault: with_copy(
                lambda copy: try_fault(fault, copy, places_by_test, seconds)
            ),
            remaining,
        )
        for row in tries:
            rows.append(row)
            console.say(f"{row['at']} | {row['after']} | {row['caught_by']}")
            record = {"machine": clock.machine(), "seed": args.seed, "rows": rows}
            write_json(args.out, record)
    console.say(page({"rows": rows, "seed": args.seed}))
    return cli.stored(args.out)


def _reach(out, workers, with_copy):
    """Return the functions that each test file enters, cached next to `out` for this
    source.
    """
    from nerfies_jax.capture.json_files import write_json

    path = out.with_suffix(".reached.json")
    digest = hashlib.blake2b(
        b"".join(sorted(map(_name_and_bytes, _files())))
    ).hexdigest()
    record = records.rows(path, reached=dict)
    places_by_test = record["reached"] if record.get("digest") == digest else {}

    def run(test):
        return test, with_copy(lambda copy: reached_by(test, copy))

    remaining = [test for test in default_tests(ROOT) if test not in places_by_test]
    jobs = [workers.submit(run, test) for test in remaining]
    try:
        for job in concurrent.futures.as_completed(jobs):
            test, places = job.result()
            places_by_test[test] = places
            write_json(path, {"digest": digest, "reached": places_by_test})
    finally:
        for job in jobs:
            job.cancel()
    return {test: set(places) for test, places in places_by_test.items()}


def _name_and_bytes(name):
    return name.encode() + (ROOT / name).read_bytes()


def _files():
    """List the existing files that git tracks."""
    files = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    names = filter(None, files.stdout.split("\0"))
    return [name for name in names if (ROOT / name).exists()]


def _is_row_of(fault, row):
    return row["at"] == f"{fault.path}:{fault.line}" and row["text"] == fault.text


def _stored_rows(path, seed):
    record = records.rows(path, rows=list)
    return record["rows"] if record.get("seed") == seed else []


def _copy(folder):
    for name in _files():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes((ROOT / name).read_bytes())
    return folder


if __name__ == "__main__":
    main()
