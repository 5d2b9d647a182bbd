"""The folder of a run, and its one owner."""

import os
import pathlib
import signal
import subprocess
import sys

import pytest

from nerfies_jax.runs import preparation, reconstruction, run_folder
from nerfies_jax.runs.config import CaptureSource, RunConfig


def test_run_folders_are_numbered_and_never_shared(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, second = (run_folder.new_run_folder(None, "ball") for _ in range(2))
    assert (first.name, second.name) == ("ball", "ball-2")
    (first / "note").write_text("kept")
    with pytest.raises(ValueError, match=r"not empty.*runs\.resume"):
        run_folder.new_run_folder(first, "ball")


def test_a_run_folder_that_cannot_be_written_is_an_early_error(tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ValueError, match=r"run folder .* out="):
            run_folder.check_free(out)  # before anything is looked at
        with pytest.raises(ValueError, match=r"run folder .* out="):
            run_folder.new_run_folder(out, "x")


def test_a_run_is_no_capture(tmp_path):
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / "config.json").write_text("{}")
    refusal = r"a run folder, .* runs\.resume\("
    with pytest.raises(ValueError, match=refusal):
        run_folder.newest_of(run)
    with pytest.raises(ValueError, match=refusal):
        preparation.prepare(run, tmp_path / "out")
    with pytest.raises(reconstruction.Refused, match="a run folder, not a capture"):
        reconstruction.reconstruct(RunConfig(None, CaptureSource(run)))


OWN = """
import pathlib, sys
from nerfies_jax.runs import run_folder
with run_folder.owned(pathlib.Path(sys.argv[1])):
    print("mine", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("end", ["in peace", "killed"])
def test_a_folder_has_one_owner_for_the_life_of_its_process(end, tmp_path):
    root = pathlib.Path(run_folder.__file__).parents[2]
    owner = subprocess.Popen(
        [sys.executable, "-c", OWN, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    try:
        assert owner.stdout.readline() == b"mine\n"
        refusal = rf"process {owner.pid} on .* \(since 20.*\) is using this run folder"
        with pytest.raises(ValueError, match=refusal):
            run_folder.new_run_folder(tmp_path, "x")
        with pytest.raises(ValueError, match=refusal), run_folder.owned(tmp_path):
            pytest.fail("owned twice")
    finally:
        if end == "killed":
            owner.send_signal(signal.SIGKILL)
        owner.communicate()
    # What it leaves is nobody's, and no run either.
    assert run_folder.new_run_folder(tmp_path, "x") == tmp_path
    with run_folder.owned(tmp_path):
        pass
