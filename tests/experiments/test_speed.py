"""Results of `experiments.speed` are stored, and compared with earlier ones."""

import copy
import json

import pytest

from experiments.speed import __main__ as speed
from experiments.speed import raster, tolerances
from nerfies_jax.metrics import clock

ONE = {"step_ms": 40.0, "compile_seconds": 9.0, "frame_ms": 7.0, "peak_mb": 1400.0}
STORED = {
    "presets": {"splats": {"one": ONE, "all": {"step_ms": 22.0}}},
    "raster": {"rows": [{"case": "10@8x8", "ratio": 1.25, "forward_ms": 3.0}]},
    "job": {"seconds": 117.0, "heldout.psnr": 32.6, "heldout.moving_psnr": None},
}


@pytest.fixture
def baseline(tmp_path):
    """A folder that has these numbers, put there one by one."""
    path = tmp_path / "speed.json"
    for which, record in STORED["presets"]["splats"].items():
        speed.keep(path, {"cpu": "a"}, ("presets", "splats", which), record)
    for name in ("raster", "job"):
        speed.keep(path, {"cpu": "a"}, (name,), STORED[name])
    return path


@pytest.fixture(autouse=True)
def nothing_measured(monkeypatch):
    nothing = {speed.Raster: lambda args: args.out / speed.STORED}
    monkeypatch.setattr(speed, "MEASURES", nothing)


def checked(out, before):
    """Return the exit code of a command that measures nothing anew."""
    with pytest.raises(SystemExit) as stop:
        speed.main(["raster", "--out", str(out), "--check", str(before)])
    return stop.value.code


def test_what_is_kept_can_be_held_against(baseline):
    metrics = clock.read_metrics(baseline)
    assert metrics == {x.key: x for x in tolerances.metrics(STORED)}
    assert set(metrics) == {
        *(f"splats.one.{name}" for name in ONE),
        *("splats.all.step_ms", "raster.10@8x8.ratio"),
        *("job.seconds", "job.heldout.psnr"),
    }
    assert metrics["splats.one.step_ms"].tolerance == 10.0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("presets", "splats", "one", "step_ms", 54.0), "splats.one.step_ms 54 ms"),
        (("presets", "splats", "one", "step_ms", 49.0), None),
        (("presets", "splats", "one", "peak_mb", 1600.0), "splats.one.peak_mb"),
        (("raster", "rows", 0, "ratio", 1.5), "raster.10@8x8.ratio"),
        (("job", "heldout.psnr", 32.0), "job.heldout.psnr 32 dB, was 32.6"),
        (("job", "seconds", 90.0), None),
    ],
)
def test_only_what_is_worse_than_its_tolerance_fails(
    change, says, baseline, tmp_path, capsys
):
    *keys, last, value = change
    now = copy.deepcopy(STORED)
    inner = now
    for key in keys:
        inner = inner[key]
    inner[last] = value
    (tmp_path / "now").mkdir()
    now["metrics"] = clock.metric_rows(tolerances.metrics(now))
    (tmp_path / "now" / "speed.json").write_text(json.dumps(now))
    assert checked(tmp_path / "now", baseline) == (0 if says is None else 1)
    printed = capsys.readouterr().out
    assert ("nothing is worse" if says is None else f"worse: {says}") in printed


def test_a_check_against_no_file_is_refused_before_anything_is_timed(tmp_path, capsys):
    assert checked(tmp_path / "out", tmp_path / "nothing.json") == 2
    assert "nothing.json" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# Another rasterizer, which draws nothing and says that it took a minute.
OTHER = """
import argparse, json
import numpy as np
parser = argparse.ArgumentParser()
for name in ("--gaussians", "--size", "--scene"):
    parser.add_argument(name)
parser.add_argument("--json", action="store_true")
args = parser.parse_args()
count = int(args.gaussians)
np.savez(
    args.scene,
    means2d=np.full((count, 2), 12.0),
    covs=np.tile([4.0, 0.5, 3.0], (count, 1)),
    depths=np.arange(1.0, count + 1),
    opacities=np.full(count, 0.5),
    colors=np.full((count, 3), 0.5),
)
print(json.dumps({"forward_ms": 30_000, "forward_backward_ms": 60_000}))
"""


@pytest.mark.slow
def test_the_rasterizer_is_timed_next_to_another_on_its_scene(tmp_path, monkeypatch):
    script = tmp_path / "other.py"
    script.write_text(OTHER)
    monkeypatch.setattr(raster, "REPEATS", 1)
    row = raster.time_case("150@40x24", script)
    assert row["forward_ms"] > 0
    assert row["forward_backward_ms"] > 0
    assert row["reference_forward_backward_ms"] == 60_000
    assert row["ratio"] == row["forward_backward_ms"] / 60_000
