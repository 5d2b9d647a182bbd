"""The inspection from the command line."""

import json

import pytest

from experiments import inspect_scene
from nerfies_jax.capture import nerfies_format
from nerfies_jax.runs import platform
from tests.preprocessing import two_planes


@pytest.mark.full
def test_the_command_line_prints_the_table_and_writes_both_files(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(platform, "start_jax", lambda *_, **__: None)
    monkeypatch.setattr(platform, "CACHE", tmp_path / "cache")
    nerfies_format.write(two_planes.make(), tmp_path / "capture")
    names = ("sheet.png", "findings.json")
    sheet, findings = (tmp_path / name for name in names)
    inspect_scene.main(
        [str(tmp_path / "capture"), "--image", str(sheet), "--findings", str(findings)]
    )
    printed = capsys.readouterr().out
    assert "splats-static-small" in printed
    assert "nerf-grid-small" in printed
    assert sheet.stat().st_size > 10_000
    assert len(list((tmp_path / "cache" / "evidence").glob("*.npz"))) == 1
    stored = json.loads(findings.read_text())
    by_name = {one["effect"]: one for one in stored["findings"]}
    assert by_name["motion"]["wanted"] is False
    assert {one["representation"] for one in stored["advice"]} == {
        "gaussians",
        "radiance",
    }
