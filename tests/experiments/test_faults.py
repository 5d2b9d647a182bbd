"""The campaign of faults notices what is lost, and passes what is not."""

import os
import pathlib
import sys

import pytest

from experiments.faults import chain, inject, jobs, page

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        sys.platform != "linux", reason="reads the environments of processes"
    ),
]

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Stands for a job: writes numbered files, slowly, and goes on where it was ended.
SETUP = """
import os, pathlib, subprocess, sys, time
from nerfies_jax.runtime import console, stopping
stopping.install()
out = pathlib.Path("out")
out.mkdir(exist_ok=True)
def work():
    stopping.check()
    until = time.process_time() + 0.02
    while time.process_time() < until:
        pass
with console.session():
    try:
        for number in range(10):
            if not (out / str(number)).exists():
                partial = out / "x.partial"
                partial.write_text("a" * number)
                work()
                partial.replace(out / str(number))
            CHANGE
    except OSError as error:
        sys.exit(f"error: {error}")
"""
CAREFUL = "console.say('line')"
CARELESS = {
    "other bits in 5": "if number == 9: (out / '5').write_text('b')",
    "exit code 7": "if number == 9: sys.exit(7)",
    "child processes are left": (
        "if number == 9: subprocess.Popen(['sleep', '30'], stdout=subprocess.DEVNULL)"
    ),
    "left behind": "if number == 9: pathlib.Path('.x.partial').touch()",
}


class Bench(jobs.Bench):
    """Without a scene and a clip."""

    def __init__(self, folder):
        self.folder, self.work = folder, folder / "work"
        self.work.mkdir(exist_ok=True)
        self.environment = {**os.environ, "PYTHONPATH": str(ROOT)}


def job(change):
    code = SETUP.replace("CHANGE", change)

    def command(bench, work):
        return [sys.executable, "-c", code]

    def files(work):
        return jobs._files(work / "out")

    return jobs.Job(command, files, lambda work: {})


@pytest.fixture
def campaign(tmp_path, monkeypatch):
    """Rows of a chain of a job that does something else at its end than it should."""
    monkeypatch.setitem(jobs.JOBS, "job", job(CAREFUL))
    bench = Bench(tmp_path)
    known = chain.reference(bench, "job")
    disk = inject.compiled_disk(tmp_path)
    monkeypatch.setattr(inject, "ORPHAN_SECONDS", 0.3)
    monkeypatch.setattr(chain, "FAULTS", 2)
    monkeypatch.setitem(inject.KINDS, "pipe", ("reader gone",))

    def run(kind, change=CAREFUL, number=0):
        monkeypatch.setitem(jobs.JOBS, "job", job(change))
        return chain.run(bench, known, f"0-{number}", kind, disk)

    return run


@pytest.mark.parametrize("kind", inject.KINDS)
def test_a_careful_job_loses_nothing(kind, campaign):
    rows = campaign(kind)
    assert rows
    assert [row["lost"] for row in rows if row["lost"]] == []
    stored = {"chains": {"0": [{**row, "job": "splats"} for row in rows]}}
    assert f"Of {len(rows)} faults 0 lost anything" in page.page(stored)


@pytest.mark.parametrize("problem", CARELESS)
def test_what_a_careless_job_loses_is_noticed(problem, campaign):
    rows = campaign("pipe", CARELESS[problem])
    (row,) = rows
    assert problem in row["lost"]


def test_a_signal_that_is_ignored_is_noticed(campaign, monkeypatch):
    monkeypatch.setattr(inject, "IGNORED_SECONDS", 0.05)
    monkeypatch.setitem(inject.KINDS, "signal", ("SIGINT",))
    ignoring = "signal.signal(signal.SIGINT, signal.SIG_IGN); time.sleep(0.1)"
    monkeypatch.setattr(f"{__name__}.SETUP", SETUP.replace("stopping.install()", ""))
    rows = campaign("signal", f"import signal; {ignoring}")
    assert "SIGINT was ignored" in [row["lost"] for row in rows]


def test_a_traceback_is_a_loss():
    for said, lost in (("Traceback (most", "a traceback"), ("warning: x", "")):
        assert inject._wrong(0, "disk full", True, said) == lost
    assert inject._wrong(-9, "SIGTERM", True, "") == "exit code -9"
    assert "no word of the disk" in inject._wrong(2, "disk full", True, "error: x")


def test_an_earlier_result_that_is_damaged_is_lost():
    whole = jobs.Job(None, None, lambda work: {"a": "2"})
    known = chain.Reference("job", {"a": "3"}, 1.0)
    assert "other bits in a" in chain._damage(whole, None, {"a": "1"}, known)
    assert chain._damage(whole, None, {"a": "2"}, known) == ""
    assert (
        chain._damage(whole, None, {"a": "1"}, known._replace(result={"a": "2"})) == ""
    )
