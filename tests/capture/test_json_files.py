"""New folders take their place whole, wherever that is, or not at all."""

import os

import pytest

from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.json_files import new_folder


def fill(path):
    with new_folder(path) as folder:
        (folder / "a").write_text("whole")


@pytest.mark.parametrize("empty", [True, False])
def test_a_link_and_the_folder_one_is_in_take_a_new_folder(
    empty, tmp_path, monkeypatch
):
    """Neither can be renamed to, and what was made in an hour was lost at the end."""
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / ("real" if empty else "absent"))
    fill(tmp_path / "link")
    assert (tmp_path / "link/a").read_text() == "whole"
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    fill(".")
    assert (tmp_path / "here/a").read_text() == "whole"
    assert not list(tmp_path.glob(".*"))


def test_a_mounted_disk_is_refused_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(os.path, "ismount", lambda path: str(path) == str(tmp_path))
    with pytest.raises(CaptureError, match=r"a whole mounted disk.*a folder in it"):
        fill(tmp_path)
    assert not list(tmp_path.iterdir())
