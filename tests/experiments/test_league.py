"""The league: which rows there are, in which order they run, what its page says."""

import dataclasses
import itertools
import json
import math
import pathlib

import pytest

from experiments import asked, cli
from experiments.ablate import pool, results
from experiments.ablate.measures import MEASURES
from experiments.ablate.results import ArmResult
from experiments.ablate.settings import Ablate
from experiments.league import contests, page, rows
from experiments.league.settings import League
from nerfies_jax.capture import synthetic
from nerfies_jax.runs import platform, representations
from nerfies_jax.runs.config import CaptureSource
from tests import scenes


def test_every_small_preset_is_a_row_and_each_motion_has_both_starts():
    arms = rows.suite().arms
    small = [name for name in representations.PRESETS if name.endswith("-small")]
    assert dict.fromkeys(arm.preset for arm in arms.values()) == dict.fromkeys(small)
    starts = {name: [n for n in arms if arms[n].preset == name] for name in small}
    for still in ("nerf-small", "t-nerf-small", "splats-mcmc-small"):
        assert starts[still] == [still]
    for rest in ("moba-small", "nsff-small"):
        assert starts[rest] == [rest, f"{rest}+tracks"]
    assert starts["4dgs-small"] == ["4dgs-small", "4dgs-small+rest"]
    # Depth is exact in built-in films: Sonata also stands without it.
    one, other = "sonata-small", "sonata-small+tracks"
    assert starts[one] == [one, f"{one}+no-depth", other, f"{other}+no-depth"]
    with pytest.raises(ValueError, match="--presets moba: choose from"):
        rows.of_presets(("moba",))


def cell(**values):
    numbers = dict.fromkeys(MEASURES, math.nan) | values
    stored = {k: x if math.isfinite(x) else None for k, x in numbers.items()}
    made = {"stopped_by": "steps", "cpu": "Abacus", "revision": 40 * "a"}
    return {"numbers": stored, **made}


def contest(names, **more):
    made = {name: {"cells": {}, "reads": []} for name in names}
    blank = {"film": "fast", "seconds": 90.0, "still": 0.02, "seeds": [0, 1, 2]}
    return blank | {"rows": made} | more


def test_the_page_of_a_part_says_what_is_there_and_what_is_missing():
    part = contest(["sonata-small+tracks", "splats-deformable-small+tracks", "nerf"])
    for seed, (one, other) in enumerate([(30.0, 29.0), (30.2, 29.1), (30.4, 29.5)]):
        own_cells = part["rows"]["sonata-small+tracks"]["cells"]
        own_cells[str(seed)] = cell(psnr=one, ssim=one / 100, train_cpu_seconds=95.0)
        other_cells = part["rows"]["splats-deformable-small+tracks"]["cells"]
        other_cells[str(seed)] = cell(psnr=other, ssim=other / 100)
    # A lucky first seed does not crown a row that has no other.
    lucky = cell(psnr=40.0) | {"stopped_by": "non-finite", "cpu": "Difference Engine"}
    lucky["revision"] = 40 * "b" + "+changes"
    part["rows"]["nerf"] = {"cells": {"0": lucky}, "reads": ["depths", "flow"]}
    empty = contest(["nerf"], film="kitchen", seconds=None)
    text = page.page({"contests": [part, empty]})
    assert text.startswith("**7 of 12 cells**")
    every = len(rows.suite().arms)
    assert f"{part['film']}`, 90 processor seconds: 3 of {every} rows." in text
    assert "No cell is of 300 processor seconds or the presets' own steps." in text
    assert "Seeds so far: 0, 1, 2" in text
    assert "`aaaaaaaaaaaaaa` 6, `bbbbbbbbbbbbbb+` 1." in text
    assert "One seed has no spread" not in text
    assert "Not there: `nerf` (seed 1, 2)." in text
    assert "Not there: `nerf`.\n" in text
    assert "| `nerf` | depths, flow | 1 | 40.00 |" in text
    assert "before their steps: `nerf` (seed 0): non-finite." in text
    assert "but for those on Difference Engine: `nerf` (seed 0)." in text
    assert "best of the 2 rows with 3 seeds, `sonata-small+tracks`, against" in text
    assert "| `nerf` | -10.00, one seed |" in text
    # Student's 95 % of gains 1.0, 1.1 and 0.9, by hand: 4.303 * 0.1 / sqrt(3).
    assert "| `splats-deformable-small+tracks` | +1.00 ± 0.25, shows |" in text
    margin = next(line for line in text.splitlines() if "| +0.31, +0.004," in line)
    assert "`splats-deformable-small` | tracks" in margin
    assert "LPIPS -0.031 |" in margin
    assert margin.endswith("| +1.00 ± 0.25, shows | +0.010 ± 0.002, shows |")
    assert "took longer" not in text
    own_cells["0"]["numbers"]["train_cpu_seconds"] = 120.4
    text = page.page({"contests": [part]})
    assert "by more than a fifth: `sonata-small+tracks` (120 s)." in text


def test_costs_beside_the_published_ones_are_a_step_of_one_over_a_step_of_the_other():
    part = contest(["moba-small", "d-miso-small+rest"])
    for seed, (ours, other) in enumerate([(20.0, 60.0), (40.0, 40.0)]):
        more = {"steps": 200.0, "render_ms": 20.0, "gaussians": 1e4, "model_mb": 1.5}
        mine = cell(psnr=25.0, ssim=0.9, train_cpu_seconds=ours, **more)
        part["rows"]["moba-small"]["cells"][str(seed)] = mine
        rival = cell(psnr=25.0, train_cpu_seconds=other, steps=100.0)
        part["rows"]["d-miso-small+rest"]["cells"][str(seed)] = rival
    text = page.page({"contests": [part]})
    # Ratios of a step 0.6 / 0.1 and 0.4 / 0.2; none of what started from tracks.
    assert "over MoBa-GS' | rest | 16 | 4.00 ± 2.83 |" in text
    assert "over MoBa-GS' | tracks | 16 |  |" in text
    assert "frames a second | rest | 163 | 50 ± 0 |" in text
    assert "Gaussians | rest | 39,000 | 10,000 ± 0 |" in text
    assert "model MB | rest | 11.3 | 1.50 ± 0.00 |" in text


def test_kept_settings_name_no_folder_of_the_machine():
    place = pathlib.Path("/somewhere/bag")
    league = asked.without_places(League(captures=(place,), out=place))
    one = Ablate(source=CaptureSource(capture=place), out=place)
    assert league["captures"] == ["bag"]
    assert asked.without_places(one)["source"]["capture"] == "bag"
    assert "somewhere" not in json.dumps([league, asked.without_places(one)])


def test_a_page_of_nothing_says_so():
    blank = contest(["nerf"])
    text = page.page({"contests": [blank]})
    assert "**0 of 3 cells**" in text
    blank["rows"]["nerf"]["cells"]["0"] = cell(psnr=40.0)
    assert "One seed has no spread" in page.page({"contests": [blank]})
    assert "No pair of these rows is there yet." in text


@pytest.fixture
def league(tmp_path, monkeypatch):
    """Three rows of the tiny scene, trained by writing down numbers."""
    monkeypatch.setattr(platform, "CACHE", tmp_path / "cache")
    monkeypatch.setitem(synthetic.PRESETS, "tiny", scenes.TINY_FILM)
    monkeypatch.setattr(cli, "SCENES", (*cli.SCENES, "tiny"))
    trained = []

    def train(job):
        (budget,) = job.budgets
        for name, seed in job.tasks():
            if job.is_finished(name, seed) or (name, seed) == ("nerf-small", 0):
                continue
            trained.append((budget.seconds, name, seed))
            identity = job.identity(name, seed, job.spec(name, 7).steps, budget)
            if budget.seconds is not None:
                identity["steps"] = 7
            numbers = dict.fromkeys(MEASURES, float(seed)) | {"steps": 7.0}
            kept = ArmResult(numbers, {}, {"steps": 7, "stopped_by": "steps"})
            results.write(job.path(name, seed, budget), identity, kept)
        return [("nerf-small", 0)] if job.seeds == (0,) else []

    monkeypatch.setattr(pool, "run", train)
    settled = League(
        scenes=("tiny",),
        presets=("nerf-small", "d-nerf-small"),
        budgets=(30.0, 9.0),
        seeds=2,
        frames=1,
        out=tmp_path / "out",
    )
    return settled, trained


def played(settled, arms):
    """The record of a league that has run as far as it can."""
    jobs = contests.opened(settled, arms)
    contests.run(settled, jobs)
    return contests.record(settled, jobs)


def test_first_seeds_come_first_and_no_seed_waits_for_a_first_that_failed(league):
    settled, trained = league
    jobs = contests.opened(settled, rows.of_presets(settled.presets))
    assert contests.run(settled, jobs) == [("nerf-small", 0)] * 2
    names = ("d-nerf-small", "d-nerf-small+tracks")
    expected = itertools.product((0, 1), (9.0, 30.0), names)
    assert trained == [(seconds, name, seed) for seed, seconds, name in expected]
    stored = json.loads(json.dumps(contests.record(settled, jobs), allow_nan=False))
    assert [one["seconds"] for one in stored["contests"]] == [9.0, 30.0]
    cells = {n: row["cells"] for n, row in stored["contests"][0]["rows"].items()}
    assert [list(cells[n]) for n in ("nerf-small", *names)] == [[], *[["0", "1"]] * 2]
    assert cells["d-nerf-small+tracks"]["1"]["numbers"]["psnr"] == 1.0
    page.draw(stored, settled.out / "league.png")
    assert (settled.out / "league.png").read_bytes().startswith(b"\x89PNG")
    # The processor's seconds are kept apart from the wall's, and both resume.
    assert all(job.budgets[0].folder.name.startswith("processor") for job in jobs)
    trained.clear()
    contests.run(settled, jobs)
    assert trained == []


def test_kept_cells_are_taken_over_where_they_would_be_made_alike(league, tmp_path):
    settled, trained = league
    arms = rows.of_presets(settled.presets)
    stored = played(settled, arms)
    path = tmp_path / "league.json"
    contests.write(path, stored)
    kept, made = contests.kept(path), len(trained)

    def elsewhere(name, **changes):
        there = dataclasses.replace(settled, out=tmp_path / name, **changes)
        return there, contests.opened(there, arms)

    there, again = elsewhere("again")
    assert contests.restore(kept, again) == made
    assert contests.restore(kept, again) == 0
    contests.run(there, again)
    assert len(trained) == made
    assert contests.record(there, again)["contests"] == stored["contests"]
    assert contests.restore(kept, elsewhere("other", tracks=2)[1]) == 0
    none = contests.kept(tmp_path / "none.json")
    assert contests.restore(none, elsewhere("none")[1]) == 0
    # Later seeds are of as many steps as the first, and that one has others here.
    for row in kept["contests"][0]["rows"].values():
        row["cells"].pop("0", None)
    _, later = elsewhere("later", budgets=(9.0,))
    assert contests.restore(kept, later) == 0


def test_what_was_not_asked_for_stays_among_the_kept(league, tmp_path):
    settled, _ = league
    arms = rows.of_presets(settled.presets)
    whole = played(settled, arms)
    few = dataclasses.replace(settled, budgets=(9.0,), seeds=1, out=tmp_path / "few")
    now = played(few, arms[1:2])
    now["contests"][0]["rows"][arms[1]]["cells"]["0"]["numbers"]["psnr"] = 7.0
    both = contests.merged(whole, now)
    whole["contests"][0]["rows"][arms[1]]["cells"]["0"]["numbers"]["psnr"] = 7.0
    assert both["contests"] == whole["contests"]
    assert contests.merged({}, now)["contests"] == now["contests"]
    # Nothing is missing of a row of former days that never had a cell.
    never = {"cells": {}, "made_with": None}
    whole["contests"][0]["rows"]["former+rest"] = never
    assert contests.merged(whole, now)["contests"] == both["contests"]
    assert page.page(json.loads(json.dumps(both)))


@pytest.mark.parametrize("which", ["measured_on", "made_with"])
def test_kept_cells_of_other_settings_are_never_lost_nor_mixed(which, league):
    settled, _ = league
    arms = rows.of_presets(settled.presets)
    whole = played(settled, arms)
    now = json.loads(json.dumps(whole))
    (part, *_) = now["contests"]
    where = part if which == "measured_on" else part["rows"][arms[1]]
    where[which] = "other settings"
    for row in part["rows"].values():
        row["cells"].pop("1", None)
    if which == "measured_on":  # and then no row's are equal
        part["rows"] = {arms[1]: part["rows"][arms[1]] | {"made_with": "other"}}
    with pytest.raises(ValueError, match=r"cells, d-nerf-small.* other settings"):
        contests.merged(whole, now)
    # All of them made anew: the old ones go.
    part["rows"] = {
        name: row | {"cells": whole["contests"][0]["rows"][name]["cells"]}
        for name, row in whole["contests"][0]["rows"].items()
    }
    assert contests.merged(whole, now)["contests"] == now["contests"]


def test_rows_are_made_anew_over_the_steps_that_they_had(league, tmp_path, monkeypatch):
    settled, _ = league
    one, other = "d-nerf-small", "d-nerf-small+tracks"
    whole = played(settled, rows.of_presets(settled.presets))
    there = dataclasses.replace(settled, out=tmp_path / "anew", budgets=(9.0,))
    jobs = contests.opened(there, (one, other))
    kept = contests.without(whole, (one,), jobs)
    assert contests.restore(kept, jobs) == 2  # both seeds of the other row
    before = json.dumps(whole)
    trained = []

    def train(self, name, seed, steps, at_most=None):
        trained.append((name, seed, steps, at_most))
        numbers = dict.fromkeys(MEASURES, 5.0) | {"steps": float(steps)}
        return ArmResult(numbers, {}, {"steps": steps, "stopped_by": "steps"})

    monkeypatch.setattr(type(jobs[0]), "_train", train)
    for name, seed in jobs[0].missing():
        jobs[0].make(name, seed, jobs[0].budgets[0])
    assert trained == [(one, 0, 7, None), (one, 1, 7, None)]  # no pilot, no second try
    now = contests.merged(kept, contests.record(there, jobs))
    assert json.dumps(whole) == before
    for old, new in zip(whole["contests"], now["contests"], strict=True):
        for name, row in new["rows"].items():
            if (name, new["seconds"]) == (one, 9.0):
                assert row["cells"]["1"]["numbers"]["psnr"] == 5.0
                row = row | {"cells": old["rows"][name]["cells"]}
            assert row == old["rows"][name]
    with pytest.raises(ValueError, match="--anew nerf-small: is not among"):
        contests.without(whole, ("nerf-small",), jobs)
    with pytest.raises(ValueError, match="nerf-small: is for what is kept"):
        League(anew=("nerf-small",))


def test_a_length_named_twice_is_one(tmp_path):
    assert League(budgets=(9.0, 9.0), own_steps=True).limits == (9.0, None)
