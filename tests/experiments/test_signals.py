"""Signals end a command soon, whatever it is doing, and it can be continued."""

import functools
import importlib.util
import itertools
import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import time

import pytest

from nerfies_jax.capture import nerfies_format
from nerfies_jax.training import checkpoint
from tests import scenes

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")

ROOT = pathlib.Path(__file__).resolve().parents[2]
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
BOUND_SECONDS = 30.0  # on a busy machine, GRACE_SECONDS on an idle one
LITTER = ("*.partial*", "*.unfinished*", "*.earlier")
STEPS = 60
QUICK = (
    *("--preset", "splats-static-small", "--steps", str(STEPS)),
    *("--evaluate-every", "1", "--checkpoint-every", "0"),
    *("--set", "strategy=none", "sh_degree=0", "init.extra_random=0"),
)


class Command:
    """A command in a process of its own, and what it has written to its streams."""

    def __init__(self, folder, *words, python=(), **environment):
        self.log = folder / "log.txt"
        self.log.touch()
        with self.log.open("wb") as file:
            self.process = subprocess.Popen(
                [sys.executable, *python, "-m", "experiments", *map(str, words)],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
            )

    def said(self):
        return self.log.read_text(errors="replace")

    def wait_until(self, is_reached):
        """Until a stage of progress, or the end of the process; returns whether it is
        still running.
        """
        until = time.monotonic() + 300
        while self.process.poll() is None and not is_reached():
            if time.monotonic() > until:
                self.process.kill()
                self.process.wait()
            time.sleep(0.005)
        return self.process.poll() is None

    def has_imported(self, module):
        return re.search(rf"\| +{re.escape(module)}$", self.said(), re.M)

    def check_ends(self, number):
        """Send a signal: the process ends in time, without a traceback or litter."""
        self.process.send_signal(number)
        try:
            code = self.process.wait(BOUND_SECONDS)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            pytest.fail(f"alive {BOUND_SECONDS} s after the signal: {self.said()}")
        said = re.sub(r"import time: .*\n", "", self.said())
        assert code == 128 + number, said
        assert "Traceback" not in said
        left = [path for name in LITTER for path in self.log.parent.rglob(name)]
        assert not left, said


# In the order in which the main job imports them: pure Python before and after JAX, a
# library of C++, and in the middle of JAX.
MODULES = ("tyro", "jaxlib", "jax._src.core", "orbax.checkpoint")


@pytest.mark.parametrize(
    ("module", "number"),
    [
        pytest.param(
            module, number, marks=() if module == "jaxlib" else pytest.mark.slow
        )
        for module, number in zip(MODULES, itertools.cycle(SIGNALS))
    ],
)
def test_a_signal_during_the_imports_ends_the_command(module, number, tmp_path):
    words = ("reconstruct", "--scene", "default", "--out", tmp_path / "run")
    command = Command(tmp_path, *words, python=("-X", "importtime"))
    assert command.wait_until(lambda: command.has_imported(module))
    command.check_ends(number)


def checkpoint_after(step):
    def is_there(folder):
        return step < max(checkpoint.steps(folder / "run/checkpoints"), default=-1)

    return is_there


def product(name):
    return lambda folder: (folder / "run" / name).exists()


def is_at(stage, command, folder):
    """Whether a run that may have been there before has begun and is at a stage."""
    return "for training" in command.said() and stage(folder)


# In the order of a run: each is waited for where the run was left at the one before.
STAGES = (
    product("config.json"),
    checkpoint_after(STEPS // 2),
    product("player.html"),
)


@pytest.mark.slow
def test_a_run_goes_on_after_a_signal_at_any_time_and_is_viewed(tmp_path):
    nerfies_format.write(scenes.tiny_capture(), tmp_path / "capture")
    words = ("reconstruct", tmp_path / "capture", *QUICK, "--out", tmp_path / "run")
    goes_on = ("reconstruct", "--out", tmp_path / "run", "--resume")
    for stage, number in zip(STAGES, SIGNALS, strict=True):
        command = Command(tmp_path, *words)
        assert command.wait_until(functools.partial(is_at, stage, command, tmp_path))
        command.check_ends(number)
        assert "--resume" in command.said()
        words = goes_on
    command = Command(tmp_path, *goes_on)
    assert command.process.wait(600) == 0, command.said()
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["train.steps"] == STEPS
    if importlib.util.find_spec("viser"):  # the viewer ends by a signal as well
        command = Command(tmp_path, "view", tmp_path / "run")
        assert command.wait_until(lambda: "look around at" in command.said())
        command.check_ends(signal.SIGINT)
