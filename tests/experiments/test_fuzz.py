"""A short form of `experiments.fuzz`, and that it notices what it is there for."""

import json
import random
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from experiments.fuzz import __main__ as fuzz
from experiments.fuzz import mutate, page, targets, worker
from nerfies_jax.capture import decoder
from nerfies_jax.capture.errors import FileError

SEED = 1  # other damage than that of the kept table


@pytest.fixture(autouse=True, scope="module")
def one_child():
    with decoder.session():
        yield


@pytest.mark.parametrize("name", targets.TARGETS)
def test_damaged_files_are_read_or_refused_by_name(tmp_path, name):
    count = max(3, targets.TARGETS[name].weight // 10)
    seen = worker.run(tmp_path, name, 0, count, SEED)
    assert seen["failures"] == []
    assert seen["read"] + seen["refused"] == count


def broken_reader(folder):
    content = (folder / "a.bin").read_bytes()
    if content == b"whole":
        return
    if len(content) > 5:
        raise FileError(f"{folder}: too long")
    if len(content) < 5:
        raise FileError("no path")
    raise KeyError("raw")


def test_failures_are_counted_and_their_files_kept(tmp_path, monkeypatch):
    target = targets.Target(
        lambda folder: (folder / "a.bin").write_bytes(b"whole"), broken_reader, 1
    )
    monkeypatch.setitem(targets.TARGETS, "broken", target)
    seen = worker.run(tmp_path, "broken", 0, 60, 0)
    kinds = {one["failure"] for one in seen["failures"]}
    assert kinds == {"KeyError in the fuzzer", "no path in the fuzzer"}
    assert len([*(tmp_path / "failures").iterdir()]) == 6  # three of each
    assert worker.current(tmp_path) == 59
    again = worker.run(tmp_path, "broken", 30, 60, 0)
    assert again["failures"] == [one for one in seen["failures"] if one["number"] >= 30]


def test_archives_are_damaged_inside_with_checksums_that_are_right(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", a=np.arange(50), b=np.arange(3))
    data = (tmp_path / "a.npz").read_bytes()
    inside = 0
    for number in range(40):
        damaged = mutate.mutate(data, "a.npz", random.Random(number))
        (tmp_path / "b.npz").write_bytes(damaged)
        try:
            with zipfile.ZipFile(tmp_path / "b.npz") as archive:
                inside += damaged != data and archive.testzip() is None
        except Exception:  # damaged outside, for which zipfile raises all sorts
            continue
    assert inside > 10


@pytest.mark.slow
def test_a_campaign_goes_on_where_it_was_ended(tmp_path):
    command = [sys.executable, "-m", "experiments", "fuzz", "--only", "npy"]
    for total in ("20", "50"):
        subprocess.run(
            [*command, "--mutations", total, "--out", str(tmp_path)],
            check=True,
            capture_output=True,
        )
        stored = json.loads((tmp_path / fuzz.STORED).read_text())
        assert stored["targets"]["npy"]["mutations"] == int(total)
    assert "Of 50 damaged files 0 were neither" in page.page(stored)
