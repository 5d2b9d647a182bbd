"""Faults at random moments of tiny jobs: nothing that was done may be lost.

    python -m experiments.faults --trials 200 --jobs 2
    python -m experiments.faults --trials 20 --only disk

A chain begins one job in a new folder and disturbs it several times, each time at a
random share of the processor time that the job takes: by SIGKILL, by SIGINT, SIGTERM or
SIGHUP, by a reader of its output that goes away, a full log or a closed stderr, by a
disk that becomes full or read-only. The first 0.15 processor seconds, in which Python
itself starts, are left out. After each fault the job is continued as a user would, and
at the end once without a fault.

A trial is one fault. It is lost if the process does not end, ends with a wrong exit
code or a traceback, leaves child processes behind or damages an earlier result. The
last trial of a chain is also lost if the job does not end with the same bits as one
that was never disturbed, or if partial files are left. Chains that are finished are
kept in --out, and the same command goes on.
"""

import concurrent.futures
import dataclasses
import pathlib
import signal
import threading

from experiments import cli
from experiments.faults import chain, inject, jobs
from nerfies_jax.runtime import console, stopping

STORED = "faults.json"


@dataclasses.dataclass(frozen=True)
class Faults:
    """Disturb tiny jobs at random moments and check what is left of them."""

    trials: int = 200
    """Number of faults."""
    only: str | None = None
    """Faults of this kind alone: kill, signal, pipe or disk."""
    only_job: str | None = None
    """This job alone: splats, moving, field, prepare, export, render or sweep."""
    jobs: int = 1
    """Chains at a time."""
    seed: int = 0
    """Draws the faults and their moments."""
    out: pathlib.Path = pathlib.Path("runs/faults")
    """Folder of faults.json, of the jobs and of their caches."""

    def __post_init__(self):
        for name in ("trials", "jobs"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} {getattr(self, name)}: at least 1")
        for name, known in (("only", inject.KINDS), ("only_job", jobs.JOBS)):
            value = getattr(self, name)
            if value is not None and value not in known:
                raise ValueError(
                    f"--{name.replace('_', '-')} {value}: choose one of "
                    + ", ".join(known)
                )


@cli.command(Faults)
def main(args):
    """Run the chains. Lost results end with exit code 1."""
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.metrics import clock
    from nerfies_jax.training.provenance import revision

    # A campaign in the background of a script, or under nohup, was started with these
    # ignored, and every job would inherit that.
    for number in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    with cli.user_errors():
        args.out.mkdir(parents=True, exist_ok=True)
        bench = jobs.Bench(args.out.resolve())
        disk = inject.compiled_disk(bench.folder)
    path = args.out / STORED
    stored = cli.stored(path) or {"seed": args.seed, "chains": {}}
    names = [args.only_job] if args.only_job else jobs.ORDER
    references = _references(bench, names, args.jobs)
    guard = threading.Lock()

    def run(number):
        with guard:
            done = sum(len(rows) for rows in stored["chains"].values())
            if str(number) in stored["chains"] or done >= args.trials:
                return
        name = names[number % len(names)]
        rows = chain.run(
            bench, references[name], f"{args.seed}-{number}", args.only, disk
        )
        with guard:
            stored["chains"][str(number)] = rows
            write_json(path, stored)
        for row in rows:
            console.say(chain.line(row))

    with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
        running = [pool.submit(run, number) for number in range(args.trials)]
        for one in concurrent.futures.as_completed(running):
            if stopping.requested():
                pool.shutdown(wait=False, cancel_futures=True)
            stopping.check()
            one.result()
    stored["machine"] = clock.machine() | {"revision": revision()}
    write_json(path, stored)
    rows = [row for rows in stored["chains"].values() for row in rows]
    lost = [row for row in rows if row["lost"]]
    console.say(f"{len(rows)} faults, {len(lost)} lost; kept in {path}")
    return cli.Ended(stored, 1 if lost else 0)


def _references(bench, names, count):
    """The jobs without faults, those first whose runs others read."""
    needed = dict.fromkeys(jobs.JOBS[name].needs for name in names)
    found = {}
    with concurrent.futures.ThreadPoolExecutor(count) as pool:
        for each in (filter(None, needed), dict.fromkeys(names)):
            missing = [name for name in each if name not in found]
            made = pool.map(lambda name: chain.reference(bench, name), missing)
            found |= zip(missing, made, strict=True)
    return found


if __name__ == "__main__":
    main()
