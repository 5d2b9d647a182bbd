"""Program of `experiments.fuzz`: damage files and read them, one after the other.

Arguments are a folder, a target, the first mutation and the one after the last, and a
seed. It writes the number of the mutation at hand to a file, so that whoever started it
knows which one never ended, and a line of JSON with what it saw in the end.
"""

import json
import os
import pathlib
import random
import shutil
import sys
import time
import traceback
import warnings

from experiments.fuzz import mutate, targets

MOST_SECONDS = 10.0  # of the processor, for one mutation
MOST_BYTES = 2**30  # of growth
KEPT = 3  # inputs of each failure


def current(folder: pathlib.Path) -> int:
    """Read the number of the mutation that a worker is at."""
    try:
        return int((folder / "current").read_text() or -1)
    except (OSError, ValueError):
        return -1


def run(
    folder: pathlib.Path, name: str, first: int, last: int, seed: int
) -> dict[str, object]:
    """Read files after each of the mutations `first` to `last` - 1.

    Returns:
      Counts of what was read and refused, failures, the longest processor time, and how
      much memory it took.
    """
    import resource

    from nerfies_jax.capture import decoder

    warnings.simplefilter("ignore")
    target, work = targets.TARGETS[name], folder / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    target.make(work)
    paths = sorted(path for path in work.rglob("*") if path.is_file())
    originals = {path: path.read_bytes() for path in paths}
    counts = {"read": 0, "refused": 0, "failures": [], "seconds": 0.0, "bytes": 0}
    with decoder.session():
        target.read(work)  # compiles, and shows that it is valid
        before = _peak(resource)
        with (folder / "current").open("w") as progress:
            for number in range(first, last):
                progress.seek(0)
                progress.write(f"{number:<20}")
                progress.flush()
                draw = random.Random(f"{seed}-{name}-{number}")
                path = draw.choice(paths)
                mutation = mutate.mutate(originals[path], path.name, draw)
                path.write_bytes(mutation)
                failure, seconds = _read(target, work, counts)
                growth = max(_peak(resource) - before, 0)
                before += growth
                counts["seconds"] = max(counts["seconds"], seconds)
                counts["bytes"] = max(counts["bytes"], growth)
                if seconds > MOST_SECONDS:
                    failure = f"took {seconds:.1f} s"
                elif growth > MOST_BYTES:
                    failure = f"grew by {growth / 2**20:.0f} MB"
                if failure:
                    _keep(folder, name, number, path, mutation, failure, counts)
                path.write_bytes(originals[path])
    return counts


def _peak(resource):
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _read(target, work, counts):
    """Read an input, and return the failure or None, and the processor time."""
    from nerfies_jax.capture.errors import FileError

    start = time.process_time()
    failure = None
    try:
        target.read(work)
        counts["read"] += 1
    except FileError as error:
        counts["refused"] += 1
        if str(work) not in str(error):
            failure = f"no path in {_place(error)}"
        elif "\n" in str(error):
            failure = f"several lines in {_place(error)}"
    # What is looked for is anything that a reader lets out.
    except (Exception, RecursionError) as error:
        failure = f"{type(error).__name__} in {_place(error)}"
    return failure, time.process_time() - start


def _place(error):
    """The innermost function of ours that an error came through."""
    ours = [
        each
        for each in traceback.extract_tb(error.__traceback__)
        if "nerfies_jax" in each.filename or "gaussians_jax" in each.filename
    ]
    if not ours:
        return "the fuzzer"
    return f"{pathlib.Path(ours[-1].filename).name}:{ours[-1].name}"


def _keep(folder, name, number, path, mutation, failure, counts):
    same = [one for one in counts["failures"] if one["failure"] == failure]
    if len(same) < KEPT:
        failures = folder / "failures"
        failures.mkdir(exist_ok=True)
        label = "".join(c if c.isalnum() else "_" for c in f"{name}-{number}")
        (failures / f"{label}-{path.name}").write_bytes(mutation)
    counts["failures"].append({"number": number, "file": path.name, "failure": failure})


def main() -> None:
    """Run what the arguments say."""
    import resource

    from nerfies_jax.runtime import children, console

    children.end_with_parent()
    folder, name, first, last, seed = sys.argv[1:]
    limit = int(os.environ.get("FUZZ_MEMORY", 0))
    if limit:
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    counts = run(pathlib.Path(folder), name, int(first), int(last), int(seed))
    console.say(json.dumps(counts))


if __name__ == "__main__":
    main()
