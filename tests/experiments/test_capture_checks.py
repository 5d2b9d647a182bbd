"""`experiments.capture_checks`: what it reads, what it finds, and its page."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from experiments import capture_checks
from nerfies_jax.capture import nerfies_format
from tests.scenes import tiny_capture


def test_problems_are_counted_and_folders_without_a_capture_named(tmp_path):
    captures = tmp_path / "captures"
    nerfies_format.write(tiny_capture(), captures / "good")
    shutil.copytree(captures / "good", captures / "without_images")
    shutil.rmtree(captures / "without_images/rgb")
    dark = dataclasses.replace(tiny_capture(), images=tiny_capture().images // 16)
    nerfies_format.write(dark, captures / "dark")
    (captures / "nothing").mkdir()
    (captures / "gaussians").mkdir()
    np.savez(
        captures / "gaussians/a.npz",
        means3d=np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 4), (50, 3)),
        colors=np.zeros((50, 3), np.uint8),
        viewmats=np.stack([np.eye(4)] * 3),
        Ks=np.stack([[[20.0, 0, 12], [0, 20, 8], [0, 0, 1]]] * 3),
        width=24,
        height=16,
    )
    with pytest.raises(SystemExit) as stop:
        capture_checks.main([str(captures), "--out", str(tmp_path / "out.json")])
    assert stop.value.code == 1
    stored = json.loads((tmp_path / "out.json").read_text())
    kinds = {row["capture"]: row["read as"] for row in stored["captures"]}
    assert kinds == {
        "dark": "nerfies",
        "gaussians": "gsplat's archive",
        "good": "nerfies",
        "without_images": "nerfies, cameras alone",
    }
    assert [*stored["passed over"]] == ["nothing"]
    problems = [
        (row["capture"], one["problem"])
        for row in stored["captures"]
        for one in row["findings"]
        if one["problem"]
    ]
    assert [name for name, _ in problems] == ["dark"], problems
    page = capture_checks.page(stored)
    assert "Of 4 captures 1 problems were reported" in page
    assert "- dark: no pixel of any image is brighter than" in page
