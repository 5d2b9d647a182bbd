"""Children end with their parent, also where that is killed."""

import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from nerfies_jax.runtime import processes

pytestmark = pytest.mark.skipif(os.name != "posix", reason="process ids of POSIX")

ROOT = pathlib.Path(__file__).resolve().parents[1]
CHILD = """
import sys, time
from nerfies_jax.runtime import children
if sys.argv[1] == "watched":  # as where the kernel has no such signal
    children._ask_kernel = lambda: False
    children.POLL_SECONDS = 0.05
children.end_with_parent()
from nerfies_jax.runtime import processes
print(processes.own_name(), flush=True)
time.sleep(60)
"""
PARENT = """
import sys, time
from nerfies_jax.runtime import children
children.start([sys.executable, "-c", sys.argv[1], sys.argv[2]])
time.sleep(60)
"""


@pytest.mark.parametrize("by", ["kernel", "watched"])
def test_a_child_ends_with_a_parent_that_is_killed(by):
    if by == "kernel" and sys.platform != "linux":
        pytest.skip("Linux alone")
    words = [sys.executable, "-c", PARENT, CHILD, by]
    parent = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    child = parent.stdout.readline().strip()
    assert not processes.has_ended(child)
    parent.send_signal(signal.SIGKILL)
    until = time.monotonic() + 120
    while not processes.has_ended(child) and time.monotonic() < until:
        time.sleep(0.02)
    assert processes.has_ended(child)
    parent.communicate()


def test_a_child_that_begins_as_an_orphan_ends():
    code = (
        "from nerfies_jax.runtime import children; "
        "children.end_with_parent(1); print('on')"
    )
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stdout) == (143, "")
