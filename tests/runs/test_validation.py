"""Training frames left out of long runs: which, and what their scores decide."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax import runs
from nerfies_jax.capture import nerfies_format
from nerfies_jax.runs import validation
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.training.loop import Hook
from tests import scenes

OVERRIDES = ("sh_degree=0", "strategy=none", "init.points=100", "init.extra_random=0")


@pytest.fixture
def config(tmp_path):
    nerfies_format.write(scenes.tiny_capture(), tmp_path / "captured")
    source = CaptureSource(tmp_path / "captured")
    return RunConfig("splats-static-small", source, 40, OVERRIDES)


def test_long_runs_on_many_frames_leave_some_out(config, monkeypatch):
    run = runs.new_run(config)
    frames = len(run.capture.train)
    assert validation.frames_to_leave_out(run, 1200) == 0  # so few training frames
    monkeypatch.setattr(validation, "MIN_FRAMES", 4)
    monkeypatch.setattr(validation, "SHARE", 0.5)
    assert validation.frames_to_leave_out(run, 1200) == frames // 2
    assert validation.frames_to_leave_out(run, 120) == 0
    # Its exposures belong to single frames.
    exposed = ("exposure.learning_rate=0.01",)
    spec = dataclasses.replace(config, overrides=(*OVERRIDES, *exposed))
    assert validation.frames_to_leave_out(runs.new_run(spec), 1200) == 0


@pytest.mark.parametrize(("frames", "count"), [(2, 1), (3, 1), (6, 4), (60, 8), (9, 0)])
def test_frames_left_out_are_spread_over_time(frames, count, rng):
    # The rows of the training frames are not in temporal order.
    train = 3 * np.arange(frames) + 1
    times = np.full(3 * frames + 1, np.nan)
    times[train] = rng.permutation(frames)
    rows = validation.spread_over_time(train, times, count)
    assert len(set(rows)) == len(rows) == count
    assert set(rows) <= set(train)
    if frames > 2 and count:
        left_out_times = np.sort(times[rows])
        assert 0 < left_out_times[0] <= left_out_times[-1] < frames - 1
        gaps = np.diff([-1, *left_out_times, frames])
        assert gaps.max() <= 2 * max(frames / (count + 1), 1)


def test_frames_left_out_are_not_trained_on(config):
    run = runs.new_run(dataclasses.replace(config, validation=1))
    (row,) = validation.rows(run)
    train = run.capture.train
    times = run.capture.times[train]
    assert times.min() < run.capture.times[row] < times.max()
    frames = validation.training_frames(run)
    assert run.capture.times[row] not in np.asarray(frames.times)
    assert len(frames.times) == len(train) - 1
    everything = validation.training_frames(runs.new_run(config))
    assert len(everything.times) == len(train)
    with pytest.raises(ValueError, match="validation=-1 must be"):
        dataclasses.replace(config, validation=-1)


@pytest.mark.full
def test_a_run_ends_with_its_best_validated_state(
    config, tmp_path, monkeypatch, capsys
):
    def hooks(run, renderer):
        def score(state, step, metrics):
            return {"psnr": 30.0 - abs(step - 20) / 10}

        return (Hook(validation.VALIDATION, score, every_steps=10),)

    monkeypatch.setattr(validation, "hooks", hooks)
    config = dataclasses.replace(config, validation=1)
    outcome = runs.reconstruct(config, tmp_path / "run")
    assert not outcome.errors
    assert int(outcome.result.state.step) == 20
    assert outcome.result.steps == 40
    assert runs.restore(tmp_path / "run", outcome.run).step == 20
    newest = runs.restore(tmp_path / "run", outcome.run, newest=True)
    assert newest.step == 40
    output = capsys.readouterr().out
    assert "30.00 dB after step 20, and 28.00 dB at the end" in output

    result = outcome.result
    rows = [{**row, "psnr": 20.0 + row["step"]} for row in result.history.evaluations]
    better = result._replace(history=result.history._replace(evaluations=tuple(rows)))
    step, text = validation.outcome(outcome.run, better)
    assert step == 40
    assert text.endswith("60.00 dB, +10.00 dB in the last quarter; more time may help")
