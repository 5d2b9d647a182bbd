"""The evidence of a capture from the command line."""

import json

import pytest

from experiments.evidence import __main__ as evidence
from experiments.evidence import page, report
from nerfies_jax.capture import nerfies_format
from nerfies_jax.preprocessing import record
from nerfies_jax.runs import platform
from tests.preprocessing import films
from tests.preprocessing.test_tracks import MOVES


@pytest.mark.full
def test_the_command_line_says_draws_and_keeps_what_it_finds(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(platform, "start_jax", lambda *_: None)
    monkeypatch.setattr(report, "CACHE", tmp_path / "cache")
    nerfies_format.write(films.film(**MOVES), tmp_path / "film")
    words = [str(tmp_path / "film"), "--out", str(tmp_path / "out")]
    evidence.main(words)
    printed = capsys.readouterr().out
    assert "what moves ..." in printed
    (kept,) = (tmp_path / "cache" / "evidence").glob("*.npz")
    assert f"record: {kept}" in printed
    assert (tmp_path / "out" / "tracks.png").stat().st_size > 10_000
    stored = json.loads((tmp_path / "out" / "evidence.json").read_text())
    assert stored["found"]["tracks"] == len(record.load(kept).score)
    evidence.main([*words[:-1], str(tmp_path / "again")])
    again = capsys.readouterr().out
    assert "gathered before" in again
    assert "what moves ..." not in again


def test_the_page_leaves_out_what_was_not_measured():
    errors = dict.fromkeys(("mask_iou", "track_px", "track_lost", "path_error"))
    counts = {"tracks": 9, "paths": 0, "groups": 0, "points": 5, "seconds": 1.0}
    still = {"scene": "still", **errors, **counts, "path_deviation": None}
    row = {"method": "DIS", "enlarged": 2, "still_px": 0.1, "moving_px": 0.2}
    row |= {"far_off": 0.01, "seconds": 0.5}
    text = page.page({"scenes": [still | {"false_share": 0.002}], "flows": [row]})
    assert "| still | 0.20 | 9 | 0 | 0 | 5 | 1.0 |" in text
    assert "| DIS | 2 | 0.100 | 0.200 | 1.0 | 0.500 |" in text
