"""README.md: its programs run, its numbers equal the measured ones, its links exist."""

import json
import pathlib
import re
import statistics

import jax
import numpy as np
import pytest

import nerfies_jax as nj
from experiments.benchmark import curves
from tests import scenes

ROOT = pathlib.Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
PAGES = [path for path in ROOT.glob("*.md")] + sorted(ROOT.glob("docs/**/*.md"))


PROGRAMS = re.findall(r"```python\n(.*?)```", README, re.S)


@pytest.mark.full
@pytest.mark.parametrize("program", PROGRAMS, ids=range(len(PROGRAMS)))
def test_a_program_of_readme_runs(program, monkeypatch, capsys):
    trains = "nj.fit(" in program
    assert program.count(", 500)") == trains
    capture = scenes.tiny_capture()
    monkeypatch.setattr(nj, "built_in_scene", lambda name: capture)
    names = {}
    with jax.numpy_dtype_promotion("standard"):  # JAX's own, as a user has it
        exec(compile(program.replace(", 500)", ", 2)"), "README.md", "exec"), names)
    if trains:
        scores = re.search(r"(\d+) held-out frames: (\S+) dB", capsys.readouterr().out)
        assert int(scores[1]) == len(capture.heldout)
        assert 0 < float(scores[2]) < 60
        assert names["image"].shape[1::-1] == capture.size
    else:
        assert np.all(np.isfinite(names["gradient"]))
        assert np.any(names["gradient"] != 0)


def test_the_table_of_presets_shows_kept_numbers():
    rows = re.findall(r"^\|[^|]+\| `([^`]+)` \| ([\d.]+) dB \|$", README, re.M)
    assert len(rows) >= 5
    league = json.loads((ROOT / "docs/results/league.json").read_text())
    (contest,) = [c for c in league["contests"] if c["capture"] == "default"]
    for preset, value in rows:
        row = preset.replace(" --set start.motion=none", "+rest")
        cells = contest["rows"][row]["cells"].values()
        assert len(cells) == 3
        number = statistics.mean(cell["numbers"]["psnr"] for cell in cells)
        assert f"{number:.2f}" == value, preset


def test_the_curves_are_as_the_text_below_them_says():
    text = " ".join(README.split())
    assert "`splats-tracked` leads at every time, and after 10 seconds it" in text
    assert "Where nothing moves, `splats-static` leads from 30 seconds on" in text
    path = ROOT / "experiments/measured/benchmark.json"
    shown = curves.panels(json.loads(path.read_text()))
    moving = [lines for title, lines in shown.items() if "motion" in title]
    assert moving
    for lines in moving:
        for at in curves.TIMES:
            scores = {name: curves.psnr_at(line, at) for name, line in lines.items()}
            known = {name: x for name, x in scores.items() if x is not None}
            assert max(known, key=known.get) == "tracked"
        after_ten = curves.psnr_at(lines["tracked"], 10)
        fields = [lines[name].psnr[-1] for name in lines if name.endswith("-grid")]
        assert all(after_ten > at_the_end for at_the_end in fields)
    (static,) = (lines for title, lines in shown.items() if "motion" not in title)
    for at in (x for x in curves.TIMES if x >= 30):
        scores = {name: curves.psnr_at(line, at) for name, line in static.items()}
        known = {name: x for name, x in scores.items() if x is not None}
        assert max(known, key=known.get) == "static"


def test_every_link_leads_to_a_file():
    dead = [
        (page.name, target)
        for page in PAGES
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
        if "://" not in target and not (page.parent / target).exists()
    ]
    assert dead == []
