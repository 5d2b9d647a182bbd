"""Tests and timings of the library on one device, such as a GPU.

    nerfies study on_device                          # all parts
    nerfies study on_device --parts raster steps
    nerfies study on_device --device cpu --parts raster --cases 1000@64x48
    nerfies study results on_device --measured runs/on_device/on_device.json

The parts are `raster` (the rasterizer, forward and backward), `steps` (a training step
of every small preset), `job` (the README's first command with empty caches) and `tests`
(the core tests, in a checkout). Every case, preset and part is a process of its own
with a time limit. A failure is recorded and the others go on. Repeat a command with the
same --out to add to its results. The folder has them as `on_device.json` and as a page.
"""

import dataclasses
import os
import pathlib
import subprocess
import sys
import time
import typing
import xml.etree.ElementTree as ET
from typing import Any, Literal

from experiments import cli, records
from experiments.on_device import page
from experiments.speed import raster
from nerfies_jax.runs import platform, representations
from nerfies_jax.runtime import children, console

STORED, PAGE = "on_device.json", "on_device.md"
ROOT = pathlib.Path(__file__).resolve().parents[2]
Part = Literal["raster", "steps", "job", "tests"]
PARTS: tuple[Part, ...] = typing.get_args(Part)
CASES = ("10000@1280x720", "100000@1280x720", "1000000@1280x720")
LISTED = 20  # failed tests in the results
REASON = 300  # characters of the end of a log that give the reason of a failure


@dataclasses.dataclass(frozen=True)
class OnDevice:
    """Run tests and timings on one device."""

    parts: tuple[Part, ...] = PARTS
    """Parts to run."""
    device: platform.Device = "auto"
    """Device to compute on."""
    cases: tuple[str, ...] = CASES
    """Gaussians and image sizes for the rasterizer, as 10000@256x256."""
    presets: tuple[str, ...] = ()
    """Presets whose steps are timed (default: all small ones)."""
    tests: tuple[str, ...] = ("tests",)
    """Arguments of pytest."""
    minutes: float = 10.0
    """Time limit of each case, preset and part."""
    out: pathlib.Path = pathlib.Path("runs/on_device")
    """Folder of the results."""

    def __post_init__(self):
        cli.check_presets(self.presets)
        for case in self.cases:
            raster.parse_case(case)
        if not self.minutes > 0:
            raise ValueError(f"--minutes {self.minutes} must be positive")


@cli.command(OnDevice)
def main(args):
    """Run all parts and write results and page. Wrong input ends with exit code 2."""
    with cli.user_errors():
        args.out.mkdir(parents=True, exist_ok=True)
        path = args.out / STORED
        results = records.rows(path)
        for part, name in _work(args):
            console.say(f"{part} {name} ...")
            record = _tests(args) if part == "tests" else _measure(args, part, name)
            machine = record.pop("machine", None)
            results.setdefault(part, {})[name] = record
            if record["failure"]:
                console.say(f"{part} {name} failed: {record['failure']}")
            records.write(path, results, *([machine] if machine else []))
            (args.out / PAGE).write_text(f"# On one device\n\n{page.page(results)}\n")
    console.say(f"stored in {path} and {args.out / PAGE}")
    return results


def _work(args):
    """Return parts and names of all measurements, each for a process of its own."""
    small = tuple(n for n in representations.PRESETS if n.endswith("-small"))
    names = {
        "raster": args.cases,
        "steps": args.presets or small,
        "job": ("default",),
        "tests": (" ".join(args.tests),),
    }
    return [
        (part, name) for part in PARTS if part in args.parts for name in names[part]
    ]


def _measure(args, part, name):
    """Return what a process measured, or the reason why it did not."""
    result = (args.out / "part.json").absolute()
    result.unlink(missing_ok=True)
    words = ["experiments.on_device.worker", part, name, args.device, str(result)]
    record = _run_limited(args, words, f"{part}.log")
    if not record["failure"]:
        record |= records.one(result, {}) or {"failure": "it left no result"}
    result.unlink(missing_ok=True)
    return record


def _tests(args):
    """Return the counts of a run of pytest."""
    if not (ROOT / "tests").is_dir():
        return {"failure": f"{ROOT} is no checkout with tests", "seconds": 0.0}
    report = (args.out / "tests.xml").absolute()
    report.unlink(missing_ok=True)
    words = ["pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={report}"]
    record = _run_limited(args, [*words, *args.tests], "tests.log")
    if not report.exists():
        return record
    counts = dict.fromkeys(("passed", "failed", "skipped"), 0)
    failed_tests = []
    for case in ET.parse(report).iter("testcase"):
        outcome = {child.tag for child in case}
        if outcome & {"failure", "error"}:
            counts["failed"] += 1
            failed_tests.append(f"{case.get('classname')}.{case.get('name')}")
        else:
            counts["skipped" if "skipped" in outcome else "passed"] += 1
    # Failed tests are a result.
    return record | counts | {"failure": "", "failed_tests": failed_tests[:LISTED]}


def _run_limited(args, words, log):
    """Run a Python module within the time limit, and kill it with all its children."""
    import psutil

    # Several processes may share the device.
    environment = dict(os.environ, XLA_PYTHON_CLIENT_PREALLOCATE="false")
    if args.device != "auto":
        environment["JAX_PLATFORMS"] = {"gpu": "cuda"}.get(args.device, args.device)
    began = time.monotonic()
    with open(args.out / log, "w+") as output:
        process = children.start(
            [sys.executable, "-W", "ignore", "-m", *words],
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            cwd=ROOT,
        )
        try:
            code, failure = process.wait(60 * args.minutes), ""
        except subprocess.TimeoutExpired:
            for child in psutil.Process(process.pid).children(recursive=True):
                child.kill()
            process.kill()
            process.wait()
            code, failure = 0, f"it took more than {args.minutes:g} minutes"
        output.seek(0)
        text = output.read().strip()
    if code:
        failure = f"exit code {code}: {text[-REASON:]}"
    record: dict[str, Any] = {"failure": failure}
    record["seconds"] = round(time.monotonic() - began, 1)
    return record


if __name__ == "__main__":
    main()
