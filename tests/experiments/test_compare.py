"""Runs laid over each other, from folders as `reconstruct` leaves them."""

import json

import pytest

from experiments import compare
from nerfies_jax.metrics import clock
from nerfies_jax.runs import curves, event_log
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.training import specs
from nerfies_jax.training.loop import History


def stored(capture):
    """What a run of a capture has in its config.json, as far as it is compared."""
    config = RunConfig("nerf", CaptureSource(f"/captures/{capture}"))
    return json.dumps({"config": specs.as_json(config), "representation": "radiance"})


def run_folder(folder, psnr, seconds=(1.0, 3.0)):
    """A finished run: its curve ends at the last of `psnr`."""
    folder.mkdir(parents=True)
    rows = [
        {"hook": "held out", "step": step, "seconds": at, "psnr": dB, "ssim": 0.5}
        for step, (at, dB) in enumerate(zip(seconds, psnr, strict=True))
    ]
    history = History(
        ({"step": 1, "seconds": 1.0, "loss": 0.1},), tuple(rows), 3.0, 2.0
    )
    curves.write(folder, history, ["frame 3"])
    metrics = {"heldout.psnr": psnr[-1], "train.seconds": seconds[-1]}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "config.json").write_text(stored("cat"))
    return folder


def test_the_table_tells_who_was_when_as_good(tmp_path, capsys):
    slow = run_folder(tmp_path / "one" / "slow", (10.0, 20.04), (2.0, 4.0))
    good = run_folder(tmp_path / "two" / "good", (10.0, 30.0), (1.0, 3.0))
    out = tmp_path / "out"
    compare.main([str(slow), str(good), "--frames", "0", "--out", str(out)])
    printed = capsys.readouterr().out
    head, first, second, *_ = printed.splitlines()
    assert "PSNR: Mean peak signal-to-noise ratio" in printed
    assert (
        "train s: Wall-clock time of all training steps, without compilation. Lower"
        in (printed)
    )
    assert head.split()[:3] == ["run", "PSNR", "train"]
    assert head.endswith("s to 20 dB")
    assert first.split() == ["slow", "20.04", "4", "4"]
    assert second.split() == ["good", "30.00", "3", "2"]
    saved = json.loads((out / "compare.json").read_text())
    assert saved["good"]["seconds_to_psnr"] == {"20.0": 2.0}
    assert (out / "curves.png").stat().st_size > 5000


def test_runs_with_codes_are_compared_by_the_protocol_of_nerf_w(tmp_path):
    plain, coded = (run_folder(tmp_path / name, (1.0, 20.0)) for name in "ab")
    scores = {"heldout.psnr": 14.04, "heldout.fitted_psnr": 17.72}
    (coded / "metrics.json").write_text(json.dumps(scores))
    compared = compare.read([plain, coded])
    head, first, second = compare.table(compared, ()).splitlines()
    assert head.split()[:4] == ["run", "PSNR", "unfitted", "PSNR"]
    assert first.split()[:3] == ["a", "20.00", "-"]
    assert second.split()[:3] == ["b", "17.72", "14.04"]
    assert any("curve of b follow NeRF-W's" in x for x in compare.remarks(compared))
    assert not any("NeRF-W" in x for x in compare.remarks(compared[:1]))


def test_a_run_that_has_not_ended_is_compared_as_far_as_it_came(tmp_path, capsys):
    good = run_folder(tmp_path / "good", (10.0, 30.0), (1.0, 3.0))
    running = tmp_path / "running"
    running.mkdir()
    (running / "config.json").write_text(stored("cat"))
    log = event_log.EventLog()
    log.open(running)
    machine = clock.machine()
    log({"kind": "run", "status": "begin", "step": 0, "machine": machine})
    log({"kind": "evaluation_frames", "frames": ["frame 3"]})
    at = {"steps": 90, "compile_seconds": 1.0}
    for step in (2, 4):
        here = {"step": step, "seconds": float(step)}
        log({"kind": "train", **here, **at, "metrics": {"loss": 1.0}})
        scores = {"psnr": 10.0 * step, "ssim": 0.5}
        log({"kind": "evaluation", "hook": "held out", **here, "metrics": scores})
    log.close()
    out = tmp_path / "out"
    words = (str(good), str(running), "--frames", "0", "--psnr", "30")
    compare.main([*words, "--out", str(out)])
    printed = capsys.readouterr().out
    assert "running has not ended and has no final scores: step 4 of 90" in printed
    saved = json.loads((out / "compare.json").read_text())
    assert saved["running"]["seconds_to_psnr"] == {"30.0": 3.0}
    assert saved["running"]["metrics"]["train.steps"] == 4


def test_runs_of_equal_names_are_told_apart(tmp_path):
    folders = [run_folder(tmp_path / name / "run", (1.0, 2.0)) for name in "ab"]
    assert [run.name for run in compare.read(folders)] == ["a/run", "b/run"]


def test_other_machines_and_frames_are_remarked(tmp_path):
    one, two = (run_folder(tmp_path / name, (1.0, 2.0)) for name in "ab")
    saved = json.loads((two / "curve.json").read_text())
    saved["machine"]["cpu"], saved["frames"] = "another", ["frame 3", "frame 9"]
    (two / "curve.json").write_text(json.dumps(saved))
    (two / "metrics.json").write_text(json.dumps({"heldout.frames": 15}))
    lines = compare.remarks(compare.read([one, two]))
    assert sum("are of 2 held-out frames" in line for line in lines) == 1
    assert any("cpu" in line and "another" in line for line in lines)
    assert any("different held-out frames (1 and 2)" in line for line in lines)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (
            lambda folder: (folder / "curve.json").unlink(),
            "neither curve.json",
        ),
        (lambda folder: (folder / "curve.json").write_text("{}"), "not a valid curve"),
        (lambda folder: (folder / "metrics.json").unlink(), "not a run"),
        (lambda folder: (folder / "config.json").write_text("{}"), "not a run"),
        (
            lambda folder: (folder / "config.json").write_text(stored("dog")),
            "capture is /captures/dog and /captures/cat",
        ),
    ],
)
def test_what_cannot_be_compared_is_refused(damage, words, tmp_path, capsys):
    one, two = (run_folder(tmp_path / name, (1.0, 2.0)) for name in "ab")
    damage(two)
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as stop:
        compare.main([str(one), str(two), "--out", str(out)])
    assert stop.value.code == 2
    assert words in capsys.readouterr().err
    assert not out.exists()
