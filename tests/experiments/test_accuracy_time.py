"""Settings under one clock: which there are, what is said of them, a tiny run of it."""

import json
import math
import pathlib
import types

import pytest

from experiments.ablate import pool
from experiments.ablate.budget import Budget
from experiments.ablate.job import Job
from experiments.ablate.measures import MEASURES
from experiments.ablate.settings import Ablate
from experiments.accuracy_time import __main__ as accuracy_time
from experiments.accuracy_time import report
from experiments.accuracy_time.axes import AXES, SETTINGS, Axis
from nerfies_jax.capture import synthetic
from nerfies_jax.measure.clock import Metric
from tests import scenes


@pytest.mark.parametrize("name", AXES)
def test_every_setting_of_an_axis_differs_from_its_base_and_the_others(name):
    job = types.SimpleNamespace(suite=SETTINGS, args=Ablate(suite="settings"))
    arms = AXES[name].settings
    specs = [(Job.spec(job, each, None), arm.environment) for each, arm in arms.items()]
    assert len(set(map(repr, specs))) == len(specs)
    assert AXES[name].base in arms


def test_a_setting_that_stands_on_two_axes_is_the_same_on_both():
    seen = {}
    for axis in AXES.values():
        for name, arm in axis.settings.items():
            assert seen.setdefault(name, arm) == arm
            assert "/" not in name  # it is part of a file's name
    assert seen == SETTINGS.arms


def test_a_share_of_steps_is_of_those_that_the_others_make():
    job = Job.__new__(Job)
    job.suite, arm = SETTINGS, SETTINGS.arms["steps-0.25"]
    for given, steps in (({}, 2000), ({"steps": 600}, 600), ({"share": 0.5}, 1000)):
        job.args = Ablate(suite="settings", **given)
        budget = Budget(job.args.steps, None, pathlib.Path(), job.args.share)
        assert job.planned_steps(arm.preset, budget) == steps
        assert job.planned_steps("steps-0.25", budget) == steps / 4


def row(**values):
    return dict.fromkeys(MEASURES, math.nan) | values


def test_a_setting_of_precision_has_its_switch_in_its_process(tmp_path, monkeypatch):
    job = types.SimpleNamespace(
        suite=SETTINGS, out=tmp_path, args=Ablate(suite="settings")
    )
    begun = {}

    def caught(words, **given):
        (name,) = json.loads(pathlib.Path(words[-1]).read_text())["arms"]
        begun[name] = given["env"]

    monkeypatch.setattr(pool.children, "start", caught)
    monkeypatch.delenv("JAX_ENABLE_X64", raising=False)
    for name in ("field-float64", "nerfies-grid-small"):
        pool.start(job, name, 0)
    assert begun["field-float64"]["JAX_ENABLE_X64"] == "1"
    assert "JAX_ENABLE_X64" not in begun["nerfies-grid-small"]


def test_a_setting_of_precision_is_refused_without_its_switch(monkeypatch):
    job = types.SimpleNamespace(suite=SETTINGS)
    monkeypatch.setenv("JAX_ENABLE_X64", "0")
    with pytest.raises(ValueError, match="field-float64 is trained under JAX_ENABLE"):
        Job._check_environment(job, "field-float64")
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    Job._check_environment(job, "field-float64")
    Job._check_environment(job, "nerfies-grid-small")


def test_the_front_is_what_nothing_beats_in_both():
    means = {
        "slow and good": row(train_cpu_seconds=9.0, psnr=30.0),
        "dominated": row(train_cpu_seconds=9.5, psnr=29.0),
        "cheap": row(train_cpu_seconds=1.0, psnr=20.0),
        "as good, dearer": row(train_cpu_seconds=2.0, psnr=20.0),
        "unknown": row(train_cpu_seconds=0.1),
    }
    front = report.front(means, "psnr", "train_cpu_seconds")
    assert front == ["cheap", "slow and good"]


def test_a_line_says_what_changed_against_the_base_and_what_it_costs():
    axis = Axis("", "base", {"base": None, "half": None})
    numbers = {}
    for seed, (dB, other) in enumerate([(20.0, 20.4), (20.2, 20.1)]):
        numbers["base", seed] = row(psnr=dB, train_cpu_seconds=100.0, render_ms=10.0)
        numbers["half", seed] = row(psnr=other, train_cpu_seconds=50.0, render_ms=5.0)
    base, half = report.axis_lines(axis, numbers)
    assert "PSNR 20.10; 100 s, 10 ms a frame" in base
    assert "PSNR 20.25 (+0.15, same); 0.50 of the training time, 0.50" in half
    one = {key: value for key, value in numbers.items() if key[1] == 0}
    assert "(+0.40, one seed)" in report.axis_lines(axis, one)[1]


def test_a_cost_may_grow_by_a_share_and_a_quality_by_a_number():
    before = Metric("a", 300.0, "", "lower")
    measure = MEASURES["train_cpu_seconds"]
    assert measure.allowed(1.0) == 2.0
    dearer = Metric("a", 440.0, "", "lower", measure.allowed(440.0))
    assert dearer.holds(before.value)
    assert not Metric("a", 460.0, "", "lower", measure.allowed(460.0)).holds(300.0)
    assert MEASURES["psnr"].allowed(30.0) == MEASURES["psnr"].tolerance
    assert measure.allowed(math.nan) == 0


@pytest.mark.slow
def test_a_tiny_plan_runs_resumes_and_is_held_against_itself(tmp_path, capfd):
    small = "rays=8 sampling.coarse=4 sampling.fine=0 start.motion=none"
    out = tmp_path / "out"
    synthetic.write(scenes.TINY_FILM, tmp_path / "film")
    words = [str(tmp_path / "film"), "--out", str(out), "--axes", "warp"]
    words += ["--share", "0.001", "--frames", "1", "--jobs", "2"]
    words += ["--set", *small.split()]
    with pytest.raises(SystemExit) as stop:
        accuracy_time.main(words)
    assert stop.value.code == 0
    printed = capfd.readouterr().out
    assert "rotation and translation, or translation alone" in printed
    assert "of the training time" in printed
    stored = json.loads((out / "accuracy_time.json").read_text())
    assert stored["metrics"]["warp-translation.steps"]["value"] == 3
    assert stored["metrics"]["nerfies-grid-small.peak_mb"]["value"] > 100
    assert all(
        (out / name).stat().st_size > 5000 for name in ("front.png", "fronts.png")
    )
    before = {path: path.stat().st_mtime for path in out.glob("*-0.json")}
    baseline = tmp_path / "baseline.json"
    stored["metrics"]["nerfies-grid-small.psnr"]["value"] += 10
    baseline.write_text(json.dumps(stored))
    with pytest.raises(SystemExit) as stop:
        accuracy_time.main([*words, "--check", str(baseline)])
    assert stop.value.code == 1
    assert "worse: nerfies-grid-small.psnr" in capfd.readouterr().out
    assert before == {path: path.stat().st_mtime for path in out.glob("*-0.json")}
