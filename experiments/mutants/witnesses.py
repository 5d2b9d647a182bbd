"""Tests that execute a function, and tests that detect a fault in it."""

import json
import os
import pathlib
import re
import subprocess
import sys
import time

from experiments.mutants.faults import Fault

CAUGHT_BY = 3
DEFAULT = "not full and not slow"
PYTEST = [sys.executable, "-m", "pytest", "-q", "-n0", "--tb=no"]
PYTEST += ["-p", "no:cacheprovider"]


def default_tests(copy: pathlib.Path) -> list[str]:
    """Return the test files of a checkout."""
    tests = (copy / "tests").rglob("test_*.py")
    return sorted(str(path.relative_to(copy)) for path in tests)


def reached_by(test: str, copy: pathlib.Path) -> list[str]:
    """Return "file:line" of each function of the packages that a test file enters.

    Its default tests run in a separate process, so that nothing has been compiled.
    Functions that a test runs in another process are not recorded.
    """
    answer = copy / f"{test.replace('/', '.')}.reached.json"
    command = [*PYTEST, "-m", DEFAULT, "-p", "experiments.mutants.reached", test]
    ran = subprocess.run(
        command,
        cwd=copy,
        capture_output=True,
        text=True,
        env=os.environ | {"MUTANTS_REACHED": str(answer)},
    )
    if ran.returncode not in (0, 5):  # all passed, or there was none
        raise ValueError(f"{test} fails without any fault:\n{ran.stdout[-2000:]}")
    return json.loads(answer.read_text())


def try_fault(
    fault: Fault,
    copy: pathlib.Path,
    places_by_test: dict[str, set[str]],
    seconds: float,
) -> dict:
    """Plant a fault, and return it with up to three tests that notice it."""
    path = copy / fault.path
    right = path.read_bytes()
    wrong = right[: fault.start] + fault.text.encode() + right[fault.end :]
    began = time.monotonic()
    tests = _tests_that_enter(fault, places_by_test)
    path.write_bytes(wrong)
    try:
        caught_by = _failures(tests, copy, seconds) if tests else []
    finally:
        path.write_bytes(right)
    return {
        "at": f"{fault.path}:{fault.line}",
        "text": fault.text,
        "before": _line(right, fault.line),
        "after": _line(wrong, fault.line),
        "files": len(tests),
        "caught_by": caught_by,
        "seconds": round(time.monotonic() - began, 1),
    }


def _line(source, line):
    return source.decode().splitlines()[line - 1].strip()


def _tests_that_enter(fault: Fault, places_by_test: dict[str, set[str]]) -> list[str]:
    """Files of tests that enter the function, those named after its module first."""
    test_name = f"test_{pathlib.Path(fault.path).stem.strip('_')}"
    place = f"{fault.path}:{fault.function}"
    entering = sorted(
        test for test, places in places_by_test.items() if place in places
    )
    entering.sort(key=lambda test: not pathlib.Path(test).name.startswith(test_name))
    return entering


def _failures(tests, copy, seconds):
    """Return up to three tests that fail, or the run itself if it does not end."""
    command = [*PYTEST, "-m", DEFAULT, "-rfE", f"--maxfail={CAUGHT_BY}", *tests]
    try:
        ran = subprocess.run(
            command, cwd=copy, capture_output=True, text=True, timeout=seconds
        )
    except subprocess.TimeoutExpired:
        return [f"does not end in {seconds:.0f} s"]
    if ran.returncode in (0, 5):  # all passed, or there was none
        return []
    names = re.findall(r"^(?:FAILED|ERROR) tests/(\S+)", ran.stdout, re.MULTILINE)
    return names or ["the tests cannot be collected"]
