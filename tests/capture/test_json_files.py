"""New folders take their place whole, wherever that is, or not at all."""

import os
import pathlib
import subprocess
import sys

import pytest

from nerfies_jax.capture import json_files
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.json_files import (
    merged_folder,
    new_folder,
    replaced_folder,
    sweep,
)
from nerfies_jax.runtime import processes


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
    with pytest.raises(CaptureError, match=r"a mount point.*a folder in it"):
        fill(tmp_path)
    assert not list(tmp_path.iterdir())


def replace(path, names, overwrite=True, replaceable=None, fail=False):
    with replaced_folder(path, overwrite, replaceable) as folder:
        for name in names:
            (folder / name).write_text("new")
        if fail:
            raise RuntimeError("in the middle")


def texts(folder):
    """Every file below a folder, hidden ones too, with what it says."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_text() for path in files}


def test_a_folder_is_replaced_by_a_complete_one_alone(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("1.png", "2.png"):
        (out / name).write_text("old")
    before = texts(tmp_path)
    with pytest.raises(RuntimeError, match="in the middle"):
        replace(out, ["7.png"], fail=True)
    with pytest.raises(CaptureError, match="already there"):
        replace(out, ["7.png"], overwrite=False)
    assert texts(tmp_path) == before
    replace(out, ["7.png"])
    assert texts(tmp_path) == {"out/7.png": "new"}


@pytest.mark.parametrize("replaceable", [None, {"1.png"}])
def test_what_a_person_put_into_a_folder_is_named_and_kept(replaceable, tmp_path):
    """Where it is known what may go, before any work is done."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "1.png").write_text("old")
    (out / "notes.txt").write_text("mine")
    (out / "elsewhere").symlink_to(tmp_path)
    names = iter(["1.png"])
    with pytest.raises(CaptureError, match="holds elsewhere, which would be lost"):
        replace(out, names, True, replaceable)
    assert (next(names, None) is None) == (replaceable is None)
    assert texts(tmp_path) == {"out/1.png": "old", "out/notes.txt": "mine"}


KILLED = """
import os, sys
from nerfies_jax.capture.json_files import replaced_file, replaced_folder

place, rename = sys.argv[1:], os.replace
def replace(source, target):
    rename(source, target)
    if str(target).endswith(".earlier"):
        os.kill(os.getpid(), 9)  # the name is free, and the new folder has not taken it
os.replace = replace
with replaced_file(place[0]) as partial:
    partial.write_text("new")
with replaced_folder(place[1], True) as folder:
    (folder / "1.png").write_text("new")
"""


def test_a_kill_between_the_two_renames_loses_nothing(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "1.png").write_text("old")
    command = [sys.executable, "-c", KILLED, str(tmp_path / "file"), str(out)]
    root = pathlib.Path(json_files.__file__).parents[2]
    assert subprocess.run(command, cwd=root).returncode == -9
    assert not out.exists()
    assert len(sweep(tmp_path)) == 2  # the earlier folder and the new one
    assert texts(tmp_path) == {"file": "new", "out/1.png": "old"}


def merge(path, names, fail=False):
    with merged_folder(path) as partial:
        for name in names:
            (partial / name).parent.mkdir(exist_ok=True)
            (partial / name).write_text("new")
        if fail:
            raise OSError(28, "No space left on device")


def test_files_of_a_folder_are_replaced_together(tmp_path):
    out = tmp_path / "run"
    out.mkdir()
    for name in ("metrics.json", "notes.txt"):
        (out / name).write_text("old")
    before = texts(tmp_path)
    names = ("metrics.json", "depth/0.exr")
    with pytest.raises(CaptureError, match=r"run: cannot be written \(No space left"):
        merge(out, names, fail=True)
    assert texts(tmp_path) == before
    merge(out, names)
    written = dict.fromkeys((f"run/{name}" for name in names), "new")
    assert texts(tmp_path) == {"run/notes.txt": "old"} | written


def test_only_what_the_dead_of_this_machine_left_is_swept(tmp_path):
    owner, machine = processes.own_name(), processes.machine()
    pid, start, _ = owner.split("-")
    dead = "4194999-7"  # above the largest process id of Linux
    contents = (
        f".a.{owner}.partial.png",
        f".a.{dead}-{'0' * 6}.partial.png",
        ".a.partial",
        ".env",
    )
    earlier = f"{pid}-{int(start) - 1}-{machine}"  # had the id of this process
    for name in (
        *contents,
        f".a b.c.{dead}-{machine}.partial.png",
        f".b.{earlier}.partial",
    ):
        (tmp_path / name).write_text("")
    (tmp_path / f".out.{dead}-{machine}.ab_1cd2e.partial" / "new").mkdir(parents=True)
    assert len(sweep(tmp_path)) == 3
    assert {path.name for path in tmp_path.iterdir()} == {*contents}
    assert sweep(tmp_path / "absent") == []
