"""The main job where training blows up: a line that says so, and an exit code."""

import json

import pytest

from experiments import reconstruct
from nerfies_jax import runs
from nerfies_jax.capture import nerfies_format
from nerfies_jax.runs import run_folder
from nerfies_jax.training import checkpoint
from tests import scenes
from tests.hard_cases import hostile

pytestmark = pytest.mark.slow

FIELD = (
    "rays=16",
    "sampling.coarse=4",
    "sampling.fine=4",
    "template.depth=1",
    "template.width=8",
    "template.color_width=8",
    "template.skips=",
    "coarse=none",
)


def reconstruct_at(tmp_path, preset, *settings):
    """The run folder, whose newest checkpoint is finite, and its steps."""
    captured, folder = tmp_path / "capture", tmp_path / "run"
    nerfies_format.write(scenes.tiny_capture(), captured)
    words = f"{captured} --preset {preset} --steps 6 --out {folder} --set".split()
    with pytest.raises(SystemExit) as stop:
        reconstruct.main([*words, *settings])
    assert stop.value.code == 1
    restored = runs.restore(folder, runs.saved_run(folder))
    assert not hostile.not_finite(restored.state)
    assert restored.step == checkpoint.latest(folder / run_folder.CHECKPOINTS)
    return folder, restored.step


def test_splats_that_blow_up_say_where_and_are_reported(tmp_path, capsys):
    # One update of an opacity by 2.8e38, with the factor of two views a step, stays in
    # float32, the second does not.
    rate = "learning_rates.opacity_logit=2e38"
    quick = ("strategy=none", "sh_degree=0")
    folder, step = reconstruct_at(tmp_path, "splats-static-small", rate, *quick)
    printed = capsys.readouterr()
    last = printed.err.splitlines()[-1]
    assert last.startswith("error: stopped at step ")
    assert "is not finite: params.rows.splats.opacity_logit (" in last
    assert "start a new run with lower learning rates" in last
    assert "--resume" not in printed.out  # it would stop at the same step
    assert json.loads((folder / "metrics.json").read_text())["train.steps"] == step
    assert (folder / "report.html").is_file()


def test_a_field_that_draws_no_numbers_leaves_no_report(tmp_path, capsys):
    rate = "learning_rate=1e38"
    folder, step = reconstruct_at(tmp_path, "nerf-small", rate, *FIELD)
    assert step == 1
    *_, error, last = capsys.readouterr().err.splitlines()
    assert error.startswith("error: no report: the images rendered at step 1 are not")
    assert last.startswith("error: stopped at step 1 of 6: step 2 is not finite: ")
    assert not (folder / "report.html").exists()
