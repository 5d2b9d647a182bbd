"""Damaged files for every reader: read, or refused with the file's path.

    nerfies study fuzz --mutations 1000000
    nerfies study fuzz --seconds 600 --only EXR

Small valid files of every kind are damaged at random (bits, integers of headers,
numbers and names in text, pieces cut out or repeated, also inside archives whose
checksums are then right again) and read as a user's would be. A reader may read such a
file or refuse it with an error of this package that names the file. Everything else is
a failure: another exception, a crash of the interpreter, more than 10 s of processor
time, growth by more than 1 GB. Readers run in processes of their own. What is finished
is kept in --out, and the same command goes on.
"""

import dataclasses
import json
import os
import pathlib
import subprocess
import sys
import time

from experiments import cli
from nerfies_jax.runtime import console, stopping

STORED = "fuzz.json"
SILENCE = 120.0  # seconds of one mutation before its process is killed
MEMORY = 24 * 2**30  # of address space of a process that reads; XLA reserves much of it


@dataclasses.dataclass(frozen=True)
class Fuzz:
    """Damage small valid files at random and check how they are read."""

    mutations: int = 1_000_000
    """Number of mutations over all readers."""
    seconds: float | None = None
    """Stop after so long (default: when all mutations are done)."""
    only: str | None = None
    """This reader alone, by its name in the table."""
    seed: int = 0
    """Draws the damage."""
    out: pathlib.Path = pathlib.Path("runs/fuzz")
    """Folder of fuzz.json and of the files that failed."""

    def __post_init__(self):
        if self.mutations < 1:
            raise ValueError(f"--mutations {self.mutations}: at least 1")
        if self.seconds is not None and not self.seconds > 0:
            raise ValueError(f"--seconds {self.seconds:g}: must be above 0")


@cli.command(Fuzz)
def main(args):
    """Run the mutations; exit code 1 where a reader failed."""
    from experiments.fuzz.targets import TARGETS
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.metrics import clock
    from nerfies_jax.training.provenance import revision

    with cli.user_errors():
        if args.only is not None and args.only not in TARGETS:
            raise ValueError(f"--only {args.only}: choose one of {', '.join(TARGETS)}")
        args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / STORED
    record = cli.stored(path) or {"seed": args.seed, "targets": {}}
    record["machine"] = clock.machine()
    # A campaign that goes on may have begun with earlier readers.
    record["revisions"] = [*dict.fromkeys([*record.get("revisions", []), revision()])]
    names = [args.only] if args.only else [*TARGETS]
    start, rounds = time.monotonic(), 1
    while (remaining := args.mutations - _count_mutations(record)) > 0:
        for name in names:
            elapsed_seconds = time.monotonic() - start
            if args.seconds is not None and elapsed_seconds > args.seconds:
                remaining = 0
                break
            stopping.check()
            # Few at first, so that a short run has seen every reader.
            share = sum(TARGETS[each].weight for each in names)
            count = min(TARGETS[name].weight * rounds, max(remaining, 1))
            count = max(1, min(count, remaining * TARGETS[name].weight // share + 1))
            _extend(record, name, count, args)
            write_json(path, record)
        if remaining <= 0:
            break
        rounds = min(4 * rounds, 32)
    failures = sum(sum(one["failures"].values()) for one in record["targets"].values())
    console.say(
        f"{_count_mutations(record)} mutations, {failures} failures; kept in {path}"
    )
    return cli.Ended(record, 1 if failures else 0)


def _count_mutations(record):
    return sum(target["mutations"] for target in record["targets"].values())


def _extend(record, name, count, args):
    """Let a process of its own read so many more mutations of a target."""
    target = record["targets"].setdefault(
        name,
        {"mutations": 0, "read": 0, "refused": 0, "failures": {}}
        | {"seconds": 0.0, "bytes": 0, "examples": []},
    )
    first = target["mutations"]
    counts = _run(args.out.resolve(), name, first, first + count, record["seed"])
    for key in ("read", "refused"):
        target[key] += counts[key]
    for key in ("seconds", "bytes"):
        target[key] = max(target[key], counts[key])
    target["mutations"] = first + counts["mutations"]
    for failure in counts["failures"]:
        words = failure["failure"]
        if words not in target["failures"]:
            console.say(f"{name}: {words} (mutation {failure['number']})")
            target["examples"].append(failure)
        target["failures"][words] = target["failures"].get(words, 0) + 1


def _run(out, name, first, last, seed):
    """Run mutations in a process, whose death is a failure as well."""
    from experiments.fuzz import worker
    from nerfies_jax.runtime import children

    (out / "current").unlink(missing_ok=True)
    command = [sys.executable, "-m", "experiments.fuzz.worker", str(out), name]
    child = children.start(
        [*command, str(first), str(last), str(seed)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "FUZZ_MEMORY": str(MEMORY), "JAX_PLATFORMS": "cpu"},
    )
    place, since, words = -1, time.monotonic(), "the interpreter crashed"
    with child:
        while True:
            try:
                answer, _ = child.communicate(timeout=1.0)
                break
            except subprocess.TimeoutExpired:
                now = worker.current(out)
                if now != place:
                    place, since = now, time.monotonic()
                elif time.monotonic() - since > SILENCE:
                    words = f"no end within {SILENCE:.0f} s"
                    child.kill()
    if child.returncode == 0:
        counts = json.loads(answer.splitlines()[-1])
        return counts | {"mutations": last - first}
    place = worker.current(out)
    if place < 0:
        raise ValueError(
            f"{name}: the process ended with code {child.returncode} before its first "
            f"mutation; try python -m experiments.fuzz.worker {out} '{name}' 0 1 0"
        )
    failure = {"number": place, "file": "", "failure": words}
    empty = {"read": 0, "refused": 0, "seconds": 0.0, "bytes": 0}
    return empty | {"failures": [failure], "mutations": place + 1 - first}


if __name__ == "__main__":
    main()
