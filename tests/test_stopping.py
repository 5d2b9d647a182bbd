"""Requests to stop: answered in good order, in time, and never swallowed."""

import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")

ROOT = pathlib.Path(__file__).resolve().parents[1]
SETUP = """
import gc, os, pathlib, sys, threading, time
from nerfies_jax.runtime import stopping
stopping.GRACE_SECONDS = 0.5
stopping.install()
stopping.at_end(lambda: print("cleaned up", flush=True))
print("ready", flush=True)
"""
# What the main thread does. Nothing but the last looks for a request.
ENDLESS = {
    "waits": "threading.Lock().acquire() and threading.Event().wait()",
    "computes": "while True: sum(range(1000))",
    "collects garbage": """
def work(phase, about):
    time.sleep(0.01)
gc.callbacks.append(work)
while True: gc.collect()
""",
    "finalizes": """
class Slow:
    def __del__(self):
        time.sleep(0.01)
while True: Slow()
""",
    "swallows": """
while True:
    try:
        stopping.check()
    except BaseException:
        pass
""",
}
CHECKS = """
while True:
    stopping.check()
    time.sleep(0.01)
"""
SAVES = """
with stopping.protected():
    time.sleep(1.5)
    print("saved", flush=True)
time.sleep(60)
"""


def begun(code, before=""):
    process = subprocess.Popen(
        [sys.executable, "-c", before + SETUP + code],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
    )
    assert process.stdout.readline() == "ready\n"
    return process


def outcome(process):
    said, _ = process.communicate(timeout=300)
    return process.returncode, said.splitlines()


@pytest.mark.parametrize("name", ENDLESS)
def test_a_signal_ends_whatever_the_main_thread_does(name):
    process = begun(ENDLESS[name])
    process.send_signal(signal.SIGINT)
    code, said = outcome(process)
    assert code == 130
    assert said[0] == "cleaned up"


def test_a_safe_point_answers_a_signal():
    process = begun(CHECKS)
    process.send_signal(signal.SIGHUP)
    assert outcome(process) == (129, [])


@pytest.mark.parametrize("count", [1, 2])
def test_a_save_is_not_cut_off(count):
    """Not by a signal that comes twice at once either, as `timeout` sends it."""
    process = begun(SAVES)
    for _ in range(count):
        process.send_signal(signal.SIGTERM)
        time.sleep(0.02)
    code, said = outcome(process)
    assert (code, said[:2]) == (143, ["saved", "cleaned up"])


@pytest.mark.parametrize("work", [SAVES, ENDLESS["waits"]])
def test_a_second_signal_ends_the_process_at_once(work):
    process = begun(work)
    process.send_signal(signal.SIGINT)
    time.sleep(0.4)
    process.send_signal(signal.SIGINT)
    code, said = outcome(process)
    assert (code, said) in [(-signal.SIGINT, []), (130, [])]


def test_a_signal_that_was_ignored_still_is():
    ignore = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)"
    process = begun("time.sleep(1); print('done')", ignore)
    process.send_signal(signal.SIGHUP)
    assert outcome(process) == (0, ["done"])


def test_pycolmap_leaves_the_handler_of_sigterm_alone():
    pytest.importorskip("pycolmap")
    code = (
        "from nerfies_jax.capture import colmap_library\n"
        "library = threading.Thread(target=colmap_library.library)\n"
        "library.start()\n"
        "library.join()\n"
        "os.kill(os.getpid(), 15)\n"
        "stopping.check()\n"
    )
    words = [sys.executable, "-c", SETUP + code]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 128 + signal.SIGTERM
    assert "SIGTERM received" not in done.stderr  # a stack trace of C++
