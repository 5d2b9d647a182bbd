"""A batch isolates its runs, names failures, keeps limits and can be continued."""

import dataclasses
import json
import os
import pathlib
import signal
import threading
import time

import pytest

from experiments import cli
from experiments.batch import __main__ as batch
from experiments.batch import engines, page, task
from tests.experiments import stand_in_run

CAPTURES = ("bear", "broken", "camel", "hungry", "killed", "slow")


class StandIn(task.Task):
    """A task that processes of an engine can load."""

    command = stand_in_run.command


def captures(folder, *names):
    paths = [folder / "captures" / name for name in names]
    for path in paths:
        path.mkdir(parents=True, exist_ok=True)
    return list(map(str, paths))


def run(*words):
    """Run the command and return its exit code."""
    with pytest.raises(SystemExit) as stop:
        batch.main(list(map(str, words)))
    return stop.value.code


def planned(folder, *names):
    args = cli.parse(
        batch.Batch, [*captures(folder, *names), "--out", str(folder / "out")]
    )
    tasks = [vars(each.task) for each in batch.plan_runs(args)]
    return [StandIn(**fields) for fields in tasks]


def test_a_batch_names_what_failed_and_continues(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(task.Task, "command", stand_in_run.command)
    out = tmp_path / "out"
    words = (*captures(tmp_path, *CAPTURES[:5]), "--preset", "nerf-small")
    more = ("--memory-gb", "0.3", "--jobs", "3", "--out", out)
    assert run(*words, *more, "--retries", "0") == 1
    stored = json.loads((out / "batch.json").read_text())
    failed = {each["run"].split(",")[0]: each for each in stored["failures"]}
    assert {name: each["code"] for name, each in failed.items()} == {
        "broken": 2,
        "hungry": -signal.SIGKILL,
        "killed": -signal.SIGKILL,
    }
    assert failed["broken"]["reason"] == "error: rays=-1"
    assert "above the memory limit of 0.3 GB" in failed["hungry"]["reason"]
    assert failed["killed"]["reason"] == "killed by SIGKILL"
    written = (out / "index.html").read_text()
    for each in failed.values():
        assert (out / each["log"]).is_file()
        assert f'href="{each["log"]}"' in written
    assert "| bear | nerf-small | 1 | 20.00 |" in capsys.readouterr().out
    # The same command continues what was killed and repeats nothing that is finished.
    assert run(*words, *more) == 1
    stored = json.loads((out / "batch.json").read_text())
    assert [each["run"].split(",")[0] for each in stored["failures"]] == ["broken"]
    assert [row["seeds"] for row in stored["rows"]] == [1, 0, 1, 1, 1]
    calls = (out / "bear" / "nerf-small-0.calls").read_text()
    assert len(calls.splitlines()) == 1
    # Runs of other settings do not mix with these.
    assert run(*words, *more, "--steps", "7") == 2
    assert (
        "holds a batch with steps=None, and this one has 7" in capsys.readouterr().err
    )


def test_killed_runs_are_continued_and_slow_ones_are_ended(tmp_path):
    killed, preempted = planned(tmp_path, "killed", "preempted")
    slow = dataclasses.replace(preempted, limits=task.Limits(seconds=1.5))
    endings = dict(engines.execute([killed, slow], engines.local, retries=1))
    assert endings[killed].code == 0
    assert endings[slow] == (143, "stopped at the time limit of 1.5 s", False)
    assert slow.log.read_text().endswith("saved\n")


def test_runs_of_a_clip_share_its_capture(tmp_path, monkeypatch):
    """The second one waits for the first, and finds the cameras estimated."""
    kinds = []

    def command(self, words):
        kinds.append(words[0])
        if words[0] == "prepare":
            folder = pathlib.Path(words[-1])
            script = f"mkdir -p {folder} && sleep 0.3 && touch {folder}/prepared.json"
            return ["sh", "-c", script]
        return stand_in_run.command(self, words)

    monkeypatch.setattr(task.Task, "command", command)
    (tmp_path / "clip.mp4").touch()
    words = (tmp_path / "clip.mp4", "--preset", "nerf-small", "sonata-small")
    assert run(*words, "--seeds", "2", "--jobs", "4", "--out", tmp_path / "out") == 1
    assert sorted(kinds) == ["prepare", *["reconstruct"] * 4]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ((), "no captures"),
        (("x", "x"), "a capture is named twice"),
        (("nowhere",), "nowhere: no such file or folder"),
        ((".", "--preset", "nerv"), "--preset nerv: no such preset"),
        ((".", "--hours", "0"), "--hours 0: must be above 0"),
        ((".", "--scheduler", "tcp://a:1"), "only with --engine dask"),
        ((".", "--engine", "slurm"), "there is no sbatch here"),
    ],
)
def test_wrong_options_are_refused(words, reason, monkeypatch, capsys):
    monkeypatch.setenv("PATH", "")
    assert run(*words) == 2
    assert reason in capsys.readouterr().err


def test_names_of_captures_are_unique():
    paths = map(pathlib.Path, ("/data/one/cat.mp4", "/data/two/cat", "/data/two/dog"))
    assert batch.unique_names(tuple(paths)) == ["one-cat", "two-cat", "two-dog"]


@pytest.mark.full
@pytest.mark.parametrize("number", [signal.SIGUSR2, signal.SIGTERM])
def test_a_preempted_job_of_submitit_resumes(tmp_path, number):
    """SIGUSR2 announces a preemption to submitit, and SIGTERM ends the run itself."""
    bear, preempted = planned(tmp_path, "bear", "preempted")
    supervisor = preempted.folder.parent / "supervisor"

    def preempt():
        while not (supervisor.exists() and supervisor.read_text()):
            time.sleep(0.05)
        process = int(supervisor.read_text())
        if number == signal.SIGTERM:  # Slurm sends it to all processes of a job
            children = pathlib.Path(f"/proc/{process}/task/{process}/children")
            for child in children.read_text().split():
                os.kill(int(child), number)
        os.kill(process, number)

    thread = threading.Thread(target=preempt)
    thread.start()
    endings = dict(
        engines.execute(
            [bear, preempted],
            lambda each: engines.slurm(each, tmp_path / "jobs", cluster="local"),
            retries=1,
        )
    )
    thread.join()
    assert [endings[each].code for each in (bear, preempted)] == [0, 0]
    assert preempted.log.read_text() == "at work\nsaved\nat work\n"
    assert "--resume" in preempted.folder.with_suffix(".calls").read_text()


@pytest.mark.full
def test_workers_of_dask_share_a_batch(tmp_path):
    pytest.importorskip("distributed")
    tasks = planned(tmp_path, "bear", "broken", "killed")
    endings = dict(
        engines.execute(tasks, lambda each: engines.dask(each, jobs=2), retries=1)
    )
    assert [endings[each].code for each in tasks] == [0, 2, 0]
    assert endings[tasks[1]].reason == "error: rays=-1"


def test_every_column_of_the_page_is_explained():
    assert {column[0] for column in page.COLUMNS} <= set(page.METRICS)
