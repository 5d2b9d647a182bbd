"""Preprocessing from the command line."""

import json

import pytest

from experiments import preprocess
from nerfies_jax.capture import nerfies_format
from nerfies_jax.preprocessing import record
from nerfies_jax.runs import platform
from tests.preprocessing import two_planes
from tests.preprocessing.test_tracks import MOVES


@pytest.mark.full
def test_the_command_line_says_draws_and_keeps_what_it_finds(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(platform, "start_jax", lambda *_, **__: None)
    monkeypatch.setattr(platform, "CACHE", tmp_path / "cache")
    nerfies_format.write(two_planes.make(**MOVES), tmp_path / "capture")
    words = [str(tmp_path / "capture"), "--out", str(tmp_path / "out")]
    preprocess.main(words)
    printed = capsys.readouterr().out
    assert "masks of moving objects ..." in printed
    (path,) = (tmp_path / "cache" / "evidence").glob("*.npz")
    assert f"stored result: {path}" in printed
    assert (tmp_path / "out" / "tracks.png").stat().st_size > 10_000
    stored = json.loads((tmp_path / "out" / "preprocessing.json").read_text())
    assert stored["found"]["tracks"] == len(record.load(path).score)
    preprocess.main([*words[:-1], str(tmp_path / "again")])
    again = capsys.readouterr().out
    assert "already preprocessed" in again
    assert "masks of moving objects ..." not in again
