"""One fault: what it does to a process, and which exit codes are right after it."""

import os
import pathlib
import signal
import subprocess
import threading
import time
from typing import Any, NamedTuple

import psutil

from nerfies_jax.runtime import children

KINDS = {
    "kill": ("SIGKILL",),
    "signal": ("SIGINT", "SIGTERM", "SIGHUP"),
    "pipe": ("reader gone", "full log", "closed stderr"),
    "disk": ("disk full", "disk read-only"),
}
SWITCHES = {"disk full": "full", "disk read-only": "readonly"}
REASONS = {
    "full": ("No space", "no space", "is full"),
    "readonly": ("Read-only", "readonly"),
}
FROM_THE_START = ("full log", "closed stderr")
BOUND_SECONDS = 240.0  # for a job that goes on after the fault, on a busy machine
END_SECONDS = 60.0  # after a signal
IGNORED_SECONDS = 5.0  # a job that completes later than this ignored its signal
ORPHAN_SECONDS = 15.0
POLL_SECONDS = 0.01
# Of the processor, for Python to start. Until then SIGINT is Python's own affair.
START_SECONDS = 0.15
MARK = "NERFIES_JAX_FAULT"  # in the environment of a job and of all its children


class Ended(NamedTuple):
    """A process after its fault."""

    code: int
    happened: bool  # False where the process ended before the fault
    said: str  # its output, as far as it could be read
    problem: str  # what is wrong; empty where nothing is


def compiled_disk(folder: pathlib.Path) -> pathlib.Path | None:
    """Compile the library that makes a disk fail.

    Args:
      folder: Folder of the library.

    Returns:
      The library, None if there is no compiler.
    """
    source = pathlib.Path(__file__).with_name("failing_disk.c")
    library = folder / "failing_disk.so"
    command = ["cc", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return library


def disturbed(
    command: list[str],
    work: pathlib.Path,
    environment: dict[str, str],
    fault: str,
    after: float,
    disk: pathlib.Path | None,
) -> Ended:
    """Run a command in a folder and let a fault happen.

    Args:
      command: The command.
      work: The folder it works in, whose disk fails.
      environment: Its environment.
      fault: Name of the fault, one of `KINDS`.
      after: Processor seconds of the command and its children until the fault.
      disk: The library of `compiled_disk`.
    """
    mark = f"{work.name}-{time.monotonic_ns()}"
    switch = work.with_name(f"{work.name}.disk")
    environment = {**environment, MARK: mark}
    if fault in SWITCHES:
        environment |= {
            "LD_PRELOAD": str(disk),
            "FAULT_FOLDER": f"{work}{os.sep}",
            "FAULT_SWITCH": str(switch),
        }
    log = work.with_name(f"{work.name}.log")
    with log.open("wb") as file:
        streams: dict[str, Any] = {"stdout": file, "stderr": file}
        if fault == "reader gone":
            streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        elif fault == "full log":
            command = ["sh", "-c", 'exec "$@" >/dev/full', "sh", *command]
        elif fault == "closed stderr":
            command = ["sh", "-c", 'exec "$@" 2>&-', "sh", *command]
        process = children.start(
            command, cwd=work, env=environment, stdin=subprocess.DEVNULL, **streams
        )
        reader = _Reader(process.stdout, file) if process.stdout else None
    happened = fault in FROM_THE_START or _wait(process, max(after, START_SECONDS))
    if happened:
        _happen(process, fault, reader, switch)
    problem, began = "", time.monotonic()
    ends = fault in (*KINDS["kill"], *KINDS["signal"])
    try:
        code = process.wait(END_SECONDS if happened and ends else BOUND_SECONDS)
    except subprocess.TimeoutExpired:
        problem = "it did not end"
        process.kill()
        code = process.wait()
    if ends and happened and code == 0 and time.monotonic() - began > IGNORED_SECONDS:
        problem = f"{fault} was ignored"
    if reader is not None:
        reader.close()
    for each in SWITCHES.values():
        pathlib.Path(f"{switch}.{each}").unlink(missing_ok=True)
    said = log.read_text(errors="replace")
    problem = problem or _orphans(mark) or _wrong(code, fault, happened, said)
    return Ended(code, happened, said, problem)


def _wait(process, after) -> bool:
    """Wait for some processor seconds of a process; False if it ended before."""
    while process.poll() is None:
        if _processor_seconds(process.pid) >= after:
            return True
        time.sleep(POLL_SECONDS)
    return False


def _processor_seconds(pid):
    try:
        main = psutil.Process(pid)
        every = [main, *main.children(recursive=True)]
    except psutil.Error:
        return 0.0
    total = 0.0
    for one in every:
        try:
            times = one.cpu_times()
        except psutil.Error:
            continue
        total += times.user + times.system
        # Of children that ended; those of other processes are among `every`.
        total += times.children_user + times.children_system
    return total


def _happen(process, fault, reader, switch):
    if fault.startswith("SIG"):
        process.send_signal(signal.Signals[fault])
    elif fault == "reader gone":
        reader.close()
    elif fault in SWITCHES:
        pathlib.Path(f"{switch}.{SWITCHES[fault]}").touch()


class _Reader:
    """Reads a pipe into a file until it is closed."""

    def __init__(self, pipe, file):
        self._pipe, self._file = pipe, os.fdopen(os.dup(file.fileno()), "wb", 0)
        os.set_blocking(pipe.fileno(), False)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self):
        while not self._stop.wait(POLL_SECONDS):
            while data := self._pipe.read(65536):
                self._file.write(data)

    def close(self):
        """Go away, whatever is still to come."""
        self._stop.set()
        self._thread.join()
        self._pipe.close()
        self._file.close()


def _orphans(mark):
    """List the running processes of a job that has ended."""
    until = time.monotonic() + ORPHAN_SECONDS
    while left := _marked(mark):
        if time.monotonic() > until:
            for one in left:
                one.kill()
            names = ", ".join(" ".join(one.info["cmdline"])[:80] for one in left)
            return f"child processes are left: {names}"
        time.sleep(0.1)
    return ""


def _marked(mark):
    found = []
    for one in psutil.process_iter(["cmdline", "environ"]):
        environment = one.info["environ"] or {}
        if environment.get(MARK) == mark and one.status() != psutil.STATUS_ZOMBIE:
            found.append(one)
    return found


def _wrong(code, fault, happened, said):
    """Describe errors of the exit code or the output."""
    if "Traceback" in said or "Exception ignored" in said:
        return "a traceback"
    if code == 0 and fault != "full log":
        return ""  # the job is complete, which is looked at later
    right = set()
    if fault.startswith("SIG") and happened:
        number = signal.Signals[fault].value
        # By the signal itself before Python has installed a handler.
        right = {-number} if fault == "SIGKILL" else {-number, 128 + number}
    elif fault == "full log":
        right = {1}
    elif fault in SWITCHES and happened:
        right = {1, 2}
        if not any(words in said for words in REASONS[SWITCHES[fault]]):
            return f"exit code {code} and no word of the disk"
    return "" if code in right else f"exit code {code}"
