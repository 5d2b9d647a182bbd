"""Every cache and every stored part of a benchmark may be damaged and is made again."""

import dataclasses
import functools
import json
import os
import pathlib
import shutil
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from experiments import records
from experiments.batch.task import COMPLETE
from nerfies_jax.capture import cache_files, synthetic
from nerfies_jax.capture.synthetic import record as scenes_record
from nerfies_jax.preprocessing import record
from tests import scenes

pytestmark = pytest.mark.slow


class Kind(NamedTuple):
    """A file that can be made again."""

    fetch: Callable[[pathlib.Path], Any]  # its content, made first if need be
    file: str  # what is damaged, below the folder
    entry: str  # what stands for all of it, and is named in the line
    # Rows that other programs read as well: without a checksum, and kept under another
    # name if damaged. And numbers of a finished run, which have no checksum either.
    aside: bool = False
    sealed: bool = True


def evidence(folder):
    evidence = record.cached(scenes.tiny_capture(), folder)
    return evidence._replace(seconds=None)


def scene(folder):
    return synthetic.cached(scenes.TINY_SCENE, folder)


def rows(folder):
    path = folder / "rows.json"
    stored = records.rows(path, rows=list)
    if not stored:
        path.write_text(json.dumps({"machine": {}, "rows": [{"psnr": 20.5}] * 9}))
        stored = records.rows(path, rows=list)
    return stored


def finished(folder):
    path = folder / "metrics.json"
    if records.one(path, COMPLETE) is None:
        path.write_text(json.dumps({"heldout.psnr": 20.5, "train.seconds": 3.25}))
    return records.one(path, COMPLETE)


KINDS = {
    "evidence": Kind(evidence, "*.npz", "*.npz"),
    "truth of a scene": Kind(scene, "*/truth.npz", "*"),
    "depth of a scene": Kind(scene, "*/depth/**/*.npy", "*"),
    "camera of a scene": Kind(scene, "*/camera/*.json", "*"),
    "manifest of a scene": Kind(scene, "*/manifest.json", "*"),
    "a finished run": Kind(finished, "metrics.json", "metrics.json", sealed=False),
    "rows of a study": Kind(rows, "rows.json", "rows.json", True, False),
}


gathered = functools.cache(lambda: GATHER(scenes.tiny_capture()))
GATHER = record.gather


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of a scene."""
    folder = tmp_path_factory.mktemp("written") / "scene"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(scenes_record, "make", lambda *_: scenes.tiny_scene())
        synthetic.write(scenes.TINY_SCENE, folder)
    return folder


@pytest.fixture(autouse=True)
def quick(monkeypatch, written):
    """What takes long is made once, and taken when it is to be made again."""
    monkeypatch.setattr(record, "gather", lambda *_, **__: gathered())
    monkeypatch.setattr(
        scenes_record,
        "_write_into",
        lambda folder, *_: shutil.copytree(written, folder, dirs_exist_ok=True),
    )


def flipped(content, place):
    return content[:place] + bytes([content[place] ^ 0x10]) + content[place + 1 :]


def other_content(path, content):
    """A whole file of this version that holds something else."""
    if path.suffix == ".npz":
        cache_files.write_arrays(path, {"other": np.zeros(3)}, "something else 1")
    elif path.suffix == ".npy":
        np.save(path, np.zeros(3, np.float32))
    else:
        path.write_text('{"other": [1, 2, 3]}')


def other_version(path, content):
    if path.suffix == ".npz":
        arrays = cache_files.npz_files.read_arrays(path)
        seal = json.loads(str(arrays.pop(cache_files.SEAL, '{"identity": ""}')))
        cache_files.write_arrays(path, arrays, seal["identity"] + "0")
    elif path.suffix == ".npy":
        np.save(path, np.load(path).astype(np.float64))
    else:
        stored = json.loads(content)
        seal = stored.pop(cache_files.SEAL, {"identity": ""})
        if "rows" in stored or not seal["identity"]:
            stored = [stored]  # files of numbers have no version but their form
            path.write_text(json.dumps(stored))
        else:
            cache_files.write_json(path, stored, seal["identity"] + "0")


def in_its_place(make):
    def damage(path, content):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        make(path)

    return damage


def a_folder(path):
    path.mkdir()
    (path / "file").write_text("in the way")


WAYS = {
    "empty": lambda path, content: path.write_bytes(b""),
    "cut in half": lambda path, content: path.write_bytes(content[: len(content) // 2]),
    "last bytes cut": lambda path, content: path.write_bytes(content[:-2]),
    "a flipped bit": lambda path, content: path.write_bytes(
        flipped(content, len(content) // 2)
    ),
    "random bytes": lambda path, content: path.write_bytes(
        np.random.default_rng(0).bytes(len(content))
    ),
    "of another version": other_version,
    "of something else": other_content,
    "a folder in its place": in_its_place(a_folder),
    "a link in its place": in_its_place(lambda path: os.symlink(path, path)),
}


def same(one, other):
    jax.tree.map(np.testing.assert_array_equal, _plain(one), _plain(other))


def _plain(value):
    """All of it in containers that can be compared leaf by leaf."""
    if dataclasses.is_dataclass(value):
        value = {x.name: getattr(value, x.name) for x in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    return np.asarray(value if value is not None else "none")


def warnings_in(capsys):
    lines = capsys.readouterr().err.splitlines()
    return [line for line in lines if line.startswith("warning: ")]


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_reported_and_made_again(kind, tmp_path, capsys):
    fetch, file, entry, aside, sealed = KINDS[kind]
    whole = fetch(tmp_path)
    path = sorted(tmp_path.glob(file))[0]
    (named, *_) = sorted(tmp_path.glob(entry))
    content = path.read_bytes()
    for way, damage in WAYS.items():
        # No number of it has a checksum, and a run is written where it was.
        if not sealed and (way == "a flipped bit" or ("place" in way and not aside)):
            continue
        capsys.readouterr()
        damage(path, content)
        same(fetch(tmp_path), whole)
        lines = warnings_in(capsys)
        assert [line for line in lines if str(named) in line], (way, lines)
        assert len(lines) == 1, (way, lines)
        assert path.is_file(), way
        same(fetch(tmp_path), whole)
        assert not warnings_in(capsys), way
        beside = named.with_name(named.name + cache_files.DAMAGED)
        assert os.path.lexists(beside) == aside, way
        if aside:
            shutil.rmtree(beside) if beside.is_dir() else beside.unlink()


@pytest.mark.parametrize("kind", ["evidence", "truth of a scene"])
def test_no_flipped_bit_becomes_a_plausible_number(kind, tmp_path):
    """Wherever it is: in a number, a header, or where nothing is read."""
    fetch, file, *_ = KINDS[kind]
    whole = fetch(tmp_path)
    path = sorted(tmp_path.glob(file))[0]
    content = path.read_bytes()
    for place in np.linspace(0, len(content) - 1, 7).astype(int):
        path.write_bytes(flipped(content, place))
        same(fetch(tmp_path), whole)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_made_again(tmp_path, capsys):
    whole = rows(tmp_path)
    (tmp_path / "rows.json").chmod(0)
    same(rows(tmp_path), whole)
    assert "Permission denied" in capsys.readouterr().err
