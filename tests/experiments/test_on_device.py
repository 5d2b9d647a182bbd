"""Parts of `experiments.on_device` are measured, and their failures recorded."""

import json

import pytest

from experiments.on_device import __main__ as command


@pytest.mark.full
def test_failures_are_recorded_next_to_measurements(tmp_path, monkeypatch):
    """One case on a CPU, one test, and a preset that exceeds its time limit."""
    monkeypatch.setenv("PYTEST_ADDOPTS", "-n 0")
    words = ["--device", "cpu", "--out", str(tmp_path)]
    small = ["--cases", "50@16x16", "--tests", "tests/test_earlier_names.py"]
    command.main([*words, "--parts", "raster", "tests", *small])
    limited = ["--parts", "steps", "--presets", "nerf-small", "--minutes", "0.002"]
    command.main([*words, *limited])
    stored = json.loads((tmp_path / "on_device.json").read_text())
    assert stored["machine"]["backend"] == "cpu"
    row = stored["raster"]["50@16x16"]
    assert row["forward_ms"] > 0
    assert row["forward_backward_ms"] > 0
    (tests,) = stored["tests"].values()
    assert (tests["failed"], tests["failed_tests"]) == (0, [])
    assert tests["passed"] > 0
    assert "0.002 minutes" in stored["steps"]["nerf-small"]["failure"]
    text = (tmp_path / "on_device.md").read_text()
    assert "The device is **cpu** (cpu)." in text
    assert "nerf-small failed: it took more than 0.002 minutes" in text
