"""Whether advice paid: which scenes are trained, what is kept, how it is judged."""

import itertools
import json
import math

import pytest

from experiments.ablate import pool, results
from experiments.ablate.arms import Arm
from experiments.inspect_pays import __main__ as inspect_pays
from experiments.inspect_pays import arms as inspect_arms
from experiments.inspect_pays import report
from experiments.inspect_pays.job import ArmMeans, Comparison, Trial, read
from nerfies_jax import runs
from nerfies_jax.capture import nerfies_format
from nerfies_jax.evidence import inspection, record, view_set
from nerfies_jax.evidence.findings import (
    BACKGROUND,
    CANNOT_TELL,
    CERTAIN,
    LIGHT,
    MOTION,
    Finding,
)
from nerfies_jax.measure import clock
from nerfies_jax.runs import adviser, platform, representations
from tests.evidence import films


def finding(effect, wanted):
    return Finding(effect, "", "", wanted, CANNOT_TELL if wanted is None else CERTAIN)


def test_whatever_is_advised_is_an_arm():
    arms = set()
    kinds = representations.installed().values()
    suite = inspect_arms.advice().arms
    for full, kind in itertools.product((False, True), kinds):
        for choices in itertools.product((True, False, None), repeat=6):
            decisions = zip(inspect_arms.DECIDING, choices, strict=True)
            findings = tuple(finding(*one) for one in decisions)
            advice = adviser.advise(findings, kind, full)
            name = inspect_arms.name_of(advice)
            assert suite[name] == Arm(advice.preset, advice.overrides)
            arms.add(name)
    against = inspect_arms.held_against()
    assert arms | {*against} == {*suite}
    for preset in against:
        assert suite[preset] == Arm(preset)
    assert not any("/" in name for name in arms)  # it is part of a file's name


def test_its_own_presets_are_such_that_advice_replaces():
    inspect_pays.check(inspect_pays.InspectPays.presets)
    inspect_pays.check(("splats-tracked", "splats-static-small", "nerf"))
    with pytest.raises(ValueError, match=r"hypernerf-small: choose from .*nerfies"):
        inspect_pays.check(("hypernerf-small",))


def side(psnr, seconds, depth=math.nan):
    return ArmMeans(psnr, depth, seconds, 1)


def row(before, after, advised="nerfies-small+appearance.width=4", refused=""):
    same = advised == "nerfies-small"
    return Comparison(
        "exposure", "nerfies-small", advised, (), same, refused, before, after
    )


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ((25.0, 60.0), (26.0, 80.0), "yes: better pictures"),
        ((25.0, 60.0), (26.0, 40.0), "yes: better pictures, quicker"),
        ((25.0, 60.0), (25.1, 40.0), "yes: as good, quicker"),
        ((25.0, 60.0), (24.9, 62.0), "neither way"),
        ((25.0, 60.0), (25.2, 70.0), "no: as good, slower"),
        ((25.0, 60.0), (24.0, 60.0), "no: worse pictures"),
        ((25.0, 60.0), (24.0, 30.0), "no: worse pictures, quicker"),
        ((25.0, 60.0, 0.02), (25.0, 62.0, 0.01), "yes: better depth"),
        ((25.0, 60.0, 0.02), (25.0, 50.0, 0.03), "no: worse depth, quicker"),
        ((25.0, 60.0, 0.02), (25.0, 60.0, 0.019), "neither way"),
        ((25.0, 60.0, 0.02), (24.0, 60.0, 0.01), "no: worse pictures"),
        ((25.0, 60.0), (math.nan, 60.0), "a run blew up"),
    ],
)
def test_quality_comes_first_and_then_time(before, after, expected):
    assert report.verdict(row(side(*before), side(*after))) == expected


def test_what_is_the_same_or_not_there_is_not_judged():
    only = row(None, side(25.0, 60.0), refused="no points")
    assert report.verdict(only) == "yes: the preset cannot be built"
    assert report.verdict(row(None, None, "nerfies-small")) == "nothing to change"
    assert report.verdict(row(side(25.0, 60.0), None)) == "not trained yet"
    assert report.metrics_of([row(None, None, "nerfies-small")]) == []


def test_the_table_says_what_is_changed():
    rows = [
        row(side(25.0, 60.0, 0.0123), side(26.0, 80.0, 0.0077)),
        row(None, None, "nerfies-small"),
        row(side(25.0, 60.0), side(25.0, 30.0), "nerf-small+appearance.width=4"),
    ]
    head, _, one, same, other = report.table(rows)
    assert one == (
        "| exposure | `nerfies-small` | `appearance.width=4` | 25.00 | 26.00 | 0.0123 "
        "| 0.0077 | 60 | 80 | yes: better pictures |"
    )
    assert head.count("|") == one.count("|")
    assert "| the same | - | - | - | - | - | - | nothing to change |" in same
    assert "`nerf-small appearance.width=4`" in other


@pytest.fixture
def film(tmp_path):
    """A still film with held-out frames, where the light is even."""
    folder = tmp_path / "film"
    nerfies_format.write(films.film(), folder)
    return folder


FOUND = (finding(MOTION, False), finding(LIGHT, True))
STILL_LIT = "splats-static-small+exposure.learning_rate=0.01"
SCORES = {"splats-deformable-small": 20.0, STILL_LIT: 24.0}


@pytest.fixture
def looked(monkeypatch):
    """Nothing is looked at and nothing trained: both are known beforehand."""
    calls = []

    def inspect(capture, folder):
        calls.append("look")
        sheet = films.texture(1).astype("uint8")
        views, evidence = view_set.in_time_order(capture), record.gather(capture)
        return inspection.Inspection(FOUND, sheet, 1, 0.0, views, evidence)

    def train(job):
        (budget,) = job.budgets
        for name, seed in job.tasks():
            if job.is_finished(name, seed):
                continue
            calls.append(f"train {name}")
            numbers = {"psnr": SCORES.get(name, 22.0), "train_cpu_seconds": 10.0}
            identity = job.identity(name, seed, budget.steps, budget)
            kept = results.ArmResult(numbers, {}, {"steps": budget.steps})
            results.write(job.path(name, seed, budget), identity, kept)
        return []

    monkeypatch.setattr(inspection, "inspect", inspect)
    monkeypatch.setattr(pool, "run", train)
    monkeypatch.setattr(platform, "start_jax", lambda *_: None)
    return calls


@pytest.mark.full
def test_what_differs_is_trained_once_and_kept(film, tmp_path, looked, capsys):
    words = [str(film), "--heldout", "3", "--out", str(tmp_path / "out")]
    words += ["--steps", "7"]
    for _ in range(2):
        with pytest.raises(SystemExit) as ended:
            inspect_pays.main(words)
        assert ended.value.code == 0
    assert looked == [
        "look",
        "train splats-deformable-small",
        f"train {STILL_LIT}",
        "train nerfies-small",
        "train nerf-small+appearance.width=4",
    ]
    printed = capsys.readouterr().out
    assert "| 20.00 | 24.00 | - | - | 10 | 10 | yes: better pictures |" in printed
    assert "2 pairs: 1 yes: better pictures; 1 neither way." in printed
    assert (tmp_path / "out/pays.md").read_text() in printed
    stored = clock.read_metrics(tmp_path / "out/pays.json")
    assert stored["film.splats-deformable-small.gain"].value == 4.0
    kept = json.loads((tmp_path / "out/film/inspected.json").read_text())
    assert kept["cost per step"]["motion"]["radiance"] > 1.2
    # Other sizes are another capture
    with pytest.raises(SystemExit) as ended:
        inspect_pays.main([*words, "--max-side", "48"])
    assert ended.value.code == 2
    assert "was read otherwise" in capsys.readouterr().err


def test_a_preset_that_needs_what_is_not_there_is_left_out(
    tmp_path, looked, monkeypatch
):
    nerfies_format.write(films.film(points=0), tmp_path / "film")
    lacking = (finding(MOTION, True), finding(BACKGROUND, False))
    monkeypatch.setattr(Trial, "findings", lambda self: lacking)
    args = inspect_pays.InspectPays(
        presets=("nerfies-small",), out=tmp_path, heldout="3", steps=7
    )
    trial = Trial(args, *read(args, tmp_path / "film"))
    assert trial.run() == []
    assert looked == ["train nerfies-small+background=none"]
    (one,) = trial.rows()
    assert "background=none" in one.refused
    assert report.verdict(one) == "yes: the preset cannot be built"


def test_a_capture_without_held_out_frames_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "stored_capture", lambda _: films.film())
    with pytest.raises(ValueError, match="--heldout 8"):
        read(inspect_pays.InspectPays(), tmp_path)
