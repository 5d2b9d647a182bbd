"""What README says: a program that runs, numbers that are kept, links that lead on."""

import json
import pathlib
import re
import statistics

import jax
import PIL.Image
import pytest

import nerfies_jax as nj
from tests import scenes

ROOT = pathlib.Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
PAGES = [path for path in ROOT.glob("*.md")] + sorted(ROOT.glob("docs/**/*.md"))


@pytest.mark.full
def test_the_program_trains_renders_and_scores(tmp_path, monkeypatch, capsys):
    (program,) = re.findall(r"```python\n(.*?)```", README, re.S)
    assert len(program.splitlines()) <= 20
    assert program.count(", 500)") == 1
    capture = scenes.tiny_capture()
    monkeypatch.setattr(nj, "built_in_scene", lambda name: capture)
    monkeypatch.chdir(tmp_path)
    with jax.numpy_dtype_promotion("standard"):  # JAX's own, as a user has it
        exec(compile(program.replace(", 500)", ", 2)"), "README.md", "exec"), {})
    scores = re.search(r"(\d+) held-out frames: (\S+) dB", capsys.readouterr().out)
    assert int(scores[1]) == len(capture.heldout)
    assert 0 < float(scores[2]) < 60
    with PIL.Image.open("held_out.png") as picture:
        assert picture.size == capture.size


def test_the_table_of_presets_shows_kept_numbers():
    rows = re.findall(r"^\|[^|]+\| `([^`]+)` \| ([\d.]+) dB \|$", README, re.M)
    assert len(rows) >= 5
    kept = json.loads((ROOT / "docs/results/league.json").read_text())
    (contest,) = [c for c in kept["contests"] if c["film"] == "default"]
    for preset, value in rows:
        row = preset.replace(" --set start.motion=none", "+rest")
        cells = contest["rows"][row]["cells"].values()
        assert len(cells) == 3
        number = statistics.mean(cell["numbers"]["psnr"] for cell in cells)
        assert f"{number:.2f}" == value, preset


def test_readme_fits_and_every_link_leads_to_a_file():
    assert len(README.splitlines()) <= 150
    dead = [
        (page.name, target)
        for page in PAGES
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
        if "://" not in target and not (page.parent / target).exists()
    ]
    assert dead == []
