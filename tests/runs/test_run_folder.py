"""The folder of a run."""

import pytest

from nerfies_jax.runs import run_folder


def test_run_folders_are_numbered_and_never_shared(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, second = (run_folder.new_run_folder(None, "ball") for _ in range(2))
    assert (first.name, second.name) == ("ball", "ball-2")
    (first / "note").write_text("kept")
    with pytest.raises(ValueError, match=r"not empty.*--resume"):
        run_folder.new_run_folder(first, "ball")


def test_a_run_folder_that_cannot_be_written_is_an_early_error(tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ValueError, match=r"run folder .*--out"):
            run_folder.new_run_folder(out, "x")
