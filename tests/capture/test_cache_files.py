"""The cache stays within a size, and processes do not make a file twice."""

import os
import threading
import time

import numpy as np
import pytest

from nerfies_jax.capture import cache, cache_files


def test_the_least_recently_used_files_are_removed(tmp_path):
    for age, name in enumerate("abcd"):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (1000 - age, 1000 - age))
    (tmp_path / ".d.partial").write_bytes(bytes(900))  # being written
    cache_files.mark_used(tmp_path / "d")  # the oldest until now
    removed = cache_files.evict(tmp_path, 250)
    assert [path.name for path in removed] == ["c", "b"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [".d.partial", "a", "d"]
    # One file above the limit stays: it was made to be read.
    cache_files.evict(tmp_path, 50)
    assert [path.name for path in tmp_path.glob("[a-z]")] == ["d"]


@pytest.mark.skipif(os.name != "posix", reason="open files are not removed")
def test_a_reader_finishes_a_removed_file(tmp_path):
    old, new = tmp_path / "old.npz", tmp_path / "new.npz"
    cache_files.write_arrays(old, {"x": np.arange(9)}, "old")
    os.utime(old, (1000, 1000))
    cache_files.write_arrays(new, {"x": np.arange(9)}, "new")
    with old.open("rb") as file:
        assert cache_files.evict(tmp_path, 10) == [old]
        np.testing.assert_array_equal(np.load(file)["x"], np.arange(9))
    # Later readers find nothing, without a warning.
    assert cache_files.read(old, lambda path: path.read_bytes()) is None


def test_two_that_need_a_file_make_it_once(tmp_path):
    path, made = tmp_path / "folder" / "record", []

    def need():
        with cache_files.making(path):
            if not path.exists():
                made.append(path)
                time.sleep(0.1)
                path.touch()

    threads = [threading.Thread(target=need) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made == [path]
    assert list(path.parent.iterdir()) == [path]


def test_the_limit_is_set_by_the_environment(monkeypatch):
    assert cache.limit_bytes() == 1e10
    monkeypatch.setenv(cache.LIMIT, "0.5")
    assert cache.limit_bytes() == 5e8
    for text in ("0", "nan", "much"):
        monkeypatch.setenv(cache.LIMIT, text)
        with pytest.raises(ValueError, match=f"NERFIES_JAX_CACHE_GB={text}: must be"):
            cache.limit_bytes()
