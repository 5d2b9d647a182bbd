"""Arms in processes of their own: what is begun when, what is left when one fails."""

import dataclasses
import pathlib
import signal
import sys
import threading
import time
import types

import pytest

from experiments.ablate import job as ablate_job
from experiments.ablate import pool, worker
from experiments.ablate.arms import Arm
from experiments.ablate.settings import Ablate
from nerfies_jax.runs import platform
from nerfies_jax.runs.config import CaptureSource

# A process that stands for an arm: it does what its own file says.
ARM = """
import pathlib, sys, time
folder, name, seed = pathlib.Path(sys.argv[1]), sys.argv[2], sys.argv[3]
(folder / f"{name}-{seed}.begun").write_text(str(time.monotonic()))
print("about to work")
time.sleep(float(sys.argv[4]))
if name == "bad":
    sys.exit("no such luck")
(folder / f"{name}-{seed}.ended").write_text(str(time.monotonic()))
"""


class Job:
    """As `experiments.ablate.job.Job`, of arms that only wait."""

    def __init__(self, out, names, seeds, seconds=0.2, **args):
        self.out, self.wait, self.budgets = out, seconds, [None]
        self.every = [(name, seed) for seed in range(seeds) for name in names]
        self.args = Ablate(**args)
        arms = {name: Arm("nerf-small") for name in names}
        self.suite = types.SimpleNamespace(arms=arms)

    def tasks(self):
        return self.every

    def is_finished(self, name, seed):
        return (self.out / f"{name}-{seed}.ended").is_file()

    def is_over(self, spent, longest):
        return self.args.budget is not None and spent + longest > self.args.budget

    def kept(self, name, seed, budget):
        names = ("psnr", "moving_psnr", "depth_median", "track_error", "train_seconds")
        return types.SimpleNamespace(numbers=dict.fromkeys(names, 1.0))

    def time_of(self, name, seed, what):
        return float((self.out / f"{name}-{seed}.{what}").read_text())


@pytest.fixture(autouse=True)
def acted(monkeypatch):
    def command(job, name, seed):
        return [sys.executable, "-c", ARM, str(job.out), name, str(seed), str(job.wait)]

    monkeypatch.setattr(pool, "command", command)


def overlap(job, one, other):
    return job.time_of(*one, "begun") < job.time_of(*other, "ended") and job.time_of(
        *other, "begun"
    ) < job.time_of(*one, "ended")


@pytest.mark.full
def test_no_more_run_at_once_than_asked_for_and_what_is_there_is_left(tmp_path, capsys):
    job = Job(tmp_path, ["a", "b", "c"], 1, seconds=1.0, jobs=2)
    (tmp_path / "b-0.ended").write_text("0")
    assert pool.run(job) == []
    assert not (tmp_path / "b-0.begun").exists()
    assert overlap(job, ("a", 0), ("c", 0))
    error = capsys.readouterr().err
    assert "[3/3] c, seed 0" in error
    assert "a, seed 0: psnr 1.00" in error
    assert (tmp_path / "logs" / "a-0.txt").read_text() == "about to work\n"


@pytest.mark.full
def test_over_seconds_later_seeds_wait_for_the_first_of_their_arm(tmp_path, capsys):
    job = Job(tmp_path, ["a", "bad"], 2, jobs=4)
    job.args = Ablate(jobs=4, seconds=1.0)
    assert sorted(pool.run(job)) == [("bad", 0), ("bad", 1)]
    assert job.time_of("a", 1, "begun") > job.time_of("a", 0, "ended")
    error = capsys.readouterr().err
    assert "bad, seed 1: not begun, seed 0 failed" in error


@pytest.mark.full
def test_an_arm_that_fails_is_named_and_the_others_go_on(tmp_path, capsys):
    job = Job(tmp_path, ["bad", "a"], 2, jobs=2)
    assert sorted(pool.run(job)) == [("bad", 0), ("bad", 1)]
    assert job.is_finished("a", 0)
    assert job.is_finished("a", 1)
    error = capsys.readouterr().err
    assert "bad, seed 1 failed (exit code 1)" in error
    assert "bad-1.txt ends with: no such luck" in error


@pytest.mark.full
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (15, 143)])
def test_a_signal_ends_every_process(tmp_path, monkeypatch, number, code):
    job = Job(tmp_path, ["a", "b"], 1, seconds=60.0, jobs=2)
    started = []
    start = pool.start

    def noted(*arguments):
        started.append(start(*arguments))
        return started[-1]

    monkeypatch.setattr(pool, "start", noted)

    def interrupt():
        while not all((tmp_path / f"{name}-0.begun").exists() for name in "ab"):
            time.sleep(0.02)
        signal.raise_signal(number)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(SystemExit) as stop:
        pool.run(job)
    thread.join()
    assert stop.value.code == code
    assert len(started) == 2
    assert all(one.process.poll() is not None for one in started)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_process_takes_the_settings_of_its_arm_from_their_file(tmp_path, monkeypatch):
    monkeypatch.undo()  # of what every test here has
    args = Ablate(
        suite="sonata",
        arms=("full", "static"),
        source=CaptureSource(pathlib.Path("a folder"), max_side=64),
        steps=30,
        seeds=3,
        jobs=4,
        budget=5.0,
        set=("strategy.cap_max=99", "sh_degree=0"),
    )
    (tmp_path / "logs").mkdir()
    words = pool.command(types.SimpleNamespace(args=args, out=tmp_path), "full", 2)
    assert words[:3] == [sys.executable, "-m", worker.__name__]
    taken, started = [], []

    def job(args):
        taken.append(args)
        return types.SimpleNamespace(run=list)  # nothing failed

    monkeypatch.setattr(ablate_job, "Job", job)
    monkeypatch.setattr(platform, "start_jax", lambda *given: started.append(given))
    with pytest.raises(SystemExit) as stop:
        worker.main(*words[3:])
    assert stop.value.code == 0
    assert started == [("auto", "one")]
    assert taken == [
        dataclasses.replace(
            args, arms=("full",), seed=2, jobs=1, budget=None, out=tmp_path
        )
    ]
