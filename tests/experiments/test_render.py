"""Renders replace each other only when they are complete, and by nobody's accident."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import render, render_folder
from nerfies_jax import evaluation, runs
from nerfies_jax.capture import images, nerfies_format
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.training.checkpoint import Restored
from nerfies_jax.training.model import Rendering, TrainState
from tests import scenes
from tests.experiments.test_export import SPLATS, saved

SWAY = ("--path", "sway", "--frames", 3, "--max-side", 24)


class Drawn:
    """Draws noise, each view in its own way, and compiles nothing."""

    def __init__(self, model, size):
        self.size = size

    def __call__(self, state, view):
        width, height = self.size
        rng = np.random.default_rng(int(1e6 * float(view.time)))
        depth = np.ones((height, width), np.float32)
        return Rendering(rng.random((height, width, 3)), depth, depth)

    def ms_per_frame(self, count):
        return 1.0


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered")
    nerfies_format.write(scenes.tiny_capture(), folder / "capture")
    source = CaptureSource(capture=folder / "capture")
    return runs.new_run(RunConfig("splats-static-small", source))


@pytest.fixture
def run(opened, tmp_path, monkeypatch):
    """A run folder whose state is never looked at."""
    folder = tmp_path / "run"
    folder.mkdir()
    runs.save_config(folder, opened)
    state = TrainState(None, None, None, jnp.int32(0), jax.random.key(0))
    restored = Restored(state, 0, None, {"crc32": 1})
    monkeypatch.setattr(runs, "saved_run", lambda *_, **__: opened)
    monkeypatch.setattr(runs, "restore", lambda *_: restored)
    monkeypatch.setattr(evaluation, "Renderer", Drawn)
    return folder


def main(*words):
    """Run the command; its exit code."""
    try:
        render.main([str(word) for word in words])
    except SystemExit as stop:
        return stop.code
    return 0


def contents(folder):
    """Bytes and times of everything below a folder, hidden files too."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {
        str(path.relative_to(folder)): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in files
    }


def fail_at(number, monkeypatch, owner, name, error):
    """Make a function raise when it is called for so many times."""
    calls, function = [], getattr(owner, name)

    def failing(*arguments, **named):
        calls.append(None)
        if len(calls) == number:
            raise error
        return function(*arguments, **named)

    monkeypatch.setattr(owner, name, failing)


def test_a_render_that_fails_leaves_the_earlier_one_as_it_was(run, monkeypatch, capsys):
    assert main(run, *SWAY) == 0
    renders = run / "renders"
    before = contents(renders)
    (folder,) = renders.iterdir()
    assert folder.name == "sway-frames-3-max-side-24"
    record = json.loads((folder / "render.json").read_text())
    assert {path.name for path in folder.iterdir()} == {*record["files"]}
    assert record["request"]["frames"] == 3
    assert record["run"]["step"] == 0
    failures = (
        (2, Drawn, "__call__", KeyboardInterrupt()),
        (3, images, "write_png", OSError(28, "No space left on device")),
        (1, os, "replace", OSError(5, "Input/output error")),
    )
    for failure in failures:
        with monkeypatch.context() as patch:
            fail_at(failure[0], patch, *failure[1:])
            assert main(run, *SWAY) in (2, 130), failure
        assert contents(renders) == before, failure
    # The video cannot be written where the images of a sequence have two sizes.
    with monkeypatch.context() as patch:
        to_uint8 = evaluation.to_uint8
        sizes = iter((24, 24, 8))
        cut = lambda color: to_uint8(color)[:, : next(sizes)]  # noqa: E731
        patch.setattr(evaluation, "to_uint8", cut)
        with pytest.raises(ValueError, match="frame 2 is"):
            main(run, *SWAY)
    assert contents(renders) == before
    # The same once more loses nothing, so nobody is asked.
    assert main(run, *SWAY) == 0
    after = contents(renders)
    assert {name: data for name, (data, _) in after.items()} == {
        name: data for name, (data, _) in before.items()
    }
    assert after != before
    assert capsys.readouterr().err.count("\n") == 3


def test_what_would_be_lost_is_named(run, tmp_path, capsys):
    out = ("--out", tmp_path / "out", "--formats", "png")
    assert main(run, *SWAY, *out) == 0
    before = contents(tmp_path / "out")

    def refused(*words):
        assert main(run, *words, *out) == 2
        return capsys.readouterr().err

    other = ("--path", "sway", "--frames", 2, "--max-side", 24)
    assert "frames is 3 there and 2 here" in refused(*other)
    assert "path is sway there and orbit here" in refused("--path", "orbit", *SWAY[2:])
    assert "max_side is 24 there and 12 here" in refused(*SWAY[:-1], 12)
    record = json.loads((tmp_path / "out/render.json").read_text())
    trained = record | {"run": record["run"] | {"step": 100}}
    (tmp_path / "out/render.json").write_text(json.dumps(trained))
    assert "step is 100 there and 0 here" in refused(*SWAY)
    (tmp_path / "out/render.json").write_text(json.dumps(record, indent=1) + "\n")
    (tmp_path / "out/0001.png").write_text("mended by hand")
    assert "0001.png was changed after it was rendered" in refused(*SWAY)
    (tmp_path / "out/notes.txt").write_text("mine")
    words = refused(*other, "--overwrite")
    assert "holds notes.txt, which would be lost" in words
    remaining = contents(tmp_path / "out")
    assert remaining.keys() == before.keys() | {"notes.txt"}
    (tmp_path / "out/notes.txt").unlink()
    assert main(run, *other, *out, "--overwrite") == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"0000.png", "0001.png", "render.json"}


@pytest.mark.parametrize("name", ["0000.png", "photo.jpg"])
def test_a_folder_that_no_render_made_keeps_what_is_not_like_one(run, tmp_path, name):
    mine = tmp_path / "mine" / name
    mine.parent.mkdir()
    mine.write_text("mine")
    words = (run, *SWAY, "--formats", "png", "--out", mine.parent)
    assert main(*words) == 2
    assert mine.read_text() == "mine"
    alike = name == "0000.png"
    assert main(*words, "--overwrite") == (0 if alike else 2)
    assert (mine.read_bytes() == b"mine") == (not alike)


def test_renders_of_other_settings_have_other_names(tmp_path):
    """Path files of one stem among them."""

    def named(**settings):
        return render_folder.name(render.Render(pathlib.Path("run"), **settings))

    for place, text in (("a", "1"), ("b", "2"), ("c", "1")):
        (tmp_path / place / "cameras").mkdir(parents=True)
        (tmp_path / place / "path.json").write_text(text)
        (tmp_path / place / "cameras" / "0.json").write_text(text)
    for kind in ("path.json", "cameras"):
        first, second, again = (named(path=str(tmp_path / p / kind)) for p in "abc")
        assert first != second
        assert first == again  # the same cameras
    names = [
        named(path="sway"),
        named(path="sway", frames=3),
        named(path="sway", max_side=64),
        named(path="sway", show="depth"),
        named(path="sway", formats=("exr",)),
        named(appearance=("cam0/1", "cam0/2")),
        named(appearance=("cam1/1", "cam0/2")),
    ]
    assert len({*names}) == len(names)
    assert names[0] == "sway"


@pytest.mark.slow
def test_a_killed_render_leaves_the_earlier_one_and_no_litter(tmp_path):
    run = saved(tmp_path, "splats-deformable-small", SPLATS, lambda params, _: params)
    words = ("--path", "sway", "--frames", 30, "--max-side", 24)
    assert main(run, *words) == 0
    before = contents(run / "renders")
    command = [sys.executable, "-m", "experiments", "render", run, *words]
    child = subprocess.Popen([str(word) for word in command])
    until = time.monotonic() + 300
    while not list((run / "renders").glob(".*.partial/new/0010.png")):
        assert time.monotonic() < until
        assert child.poll() is None
        time.sleep(0.01)
    child.send_signal(signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL
    after = contents(run / "renders")
    assert {name: data for name, data in after.items() if name in before} == before
    assert len(after) > len(before)  # what the killed one left
    assert main(run, *words) == 0
    assert contents(run / "renders").keys() == before.keys()
