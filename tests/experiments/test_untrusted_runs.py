"""Run folders from strangers: opening one never runs code that its files name."""

import importlib
import json
import os
import pathlib
import re
import subprocess
import sys
import zlib

import numpy as np
import pytest

from experiments import __main__ as commands
from experiments import cli
from gaussians_jax.io import model_file
from nerfies_jax import runs
from nerfies_jax.capture import nerfies_format
from nerfies_jax.runs import curves, train, trust
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.training.loop import History
from tests import scenes

SMALL = ("sh_degree=0", "strategy=none", "init.extra_random=0")
# It leaves a mark when it is imported, when its class is made, and when it is called.
HOLIDAY = """
import dataclasses, pathlib
import jax.numpy as jnp
from gaussians_jax.core.protocols import MotionParams

def mark(name):
    (pathlib.Path(__file__).parent / f"ran-{name}").touch()

mark("import")

class Loud:
    def __init__(self, *arguments, **fields):
        mark("class")

@dataclasses.dataclass(frozen=True)
class Drift:
    learning_rate: float = 1e-3

    def __post_init__(self):
        mark("motion")

    def init(self, key, gaussians):
        return MotionParams(jnp.zeros_like(gaussians.mean))

    def apply(self, params, cache, gaussians, frame):
        way = frame.time * params.per_gaussian
        return gaussians._replace(mean=gaussians.mean + way)
"""
DRIFT = {"type": "holiday:Drift", "learning_rate": 0.5}
OPENING = {
    "render": ("render", "RUN"),
    "export": ("export", "RUN", "transforms"),
    "view": ("view", "RUN"),
    "compare": ("compare", "RUN", "OTHER", "--out", "compared"),
    "resume": ("reconstruct", "--out", "RUN", "--resume"),
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Two runs of a tiny capture, saved before they learned anything."""
    folder = tmp_path_factory.mktemp("finished")
    nerfies_format.write(scenes.tiny_capture(), folder / "capture")
    source = CaptureSource(capture=folder / "capture")
    config = RunConfig("splats-static-small", source, steps=2, overrides=SMALL)
    run = runs.new_run(config)
    state = runs.initial_state(run)
    row = {"step": 1, "seconds": 1.0, "loss": 0.1}
    scored = {"hook": "held out", **row, "psnr": 20.0, "ssim": 0.5}
    for name in ("run", "other"):
        out = folder / name
        out.mkdir()
        runs.save_config(out, run)
        curves.write(out, History((row,), (scored,), 3.0, 2.0), ["frame 3"])
        (out / "metrics.json").write_text('{"heldout.psnr": 20.0}')
        with train.open_checkpoints(out, run, None) as checkpoints:
            checkpoints.save(state, 0, {})
    return folder


@pytest.fixture
def stranger(finished, tmp_path, monkeypatch):
    """A stranger's run folder that is current and first on the path."""
    folder = tmp_path / "stranger"
    copied = ["config.json", "curve.json", "metrics.json"]
    for name in copied:
        folder.mkdir(exist_ok=True)
        (folder / name).write_bytes((finished / "run" / name).read_bytes())
    os.symlink(finished / "run" / "checkpoints", folder / "checkpoints")
    (folder / "holiday.py").write_text(HOLIDAY)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "holiday", raising=False)
    importlib.invalidate_caches()
    return folder


def edit(path, change):
    stored = json.loads(path.read_text())
    change(stored)
    path.write_text(json.dumps(stored))


def main(words, folder, finished):
    """Run a command in the stranger's folder; its exit code."""
    places = {"RUN": str(folder), "OTHER": str(finished / "other")}
    name, *rest = (places.get(word, word) for word in words)
    try:
        commands.main_of(name)(rest)
    except SystemExit as stop:
        return stop.code
    return 0


def ran(folder):
    return sorted(path.name for path in folder.glob("ran-*"))


HOSTILE = {
    "a motion beside it": (
        lambda s: s["spec"].update(motion={"type": "holiday:Drift"}),
        r"holiday:Drift\), which is executed .* with --trust holiday:Drift",
    ),
    "a class of another package in the spec": (
        lambda s: s["spec"]["init"].update(type="holiday:Loud"),
        r"holiday:Loud\), which is executed .* with --trust holiday:Loud",
    ),
    "functions of Python": (
        lambda s: s["config"].update(overrides=["a=os:abort", "b=subprocess:Popen x"]),
        "with --trust os:abort 'subprocess:Popen x'",
    ),
    "no list of overrides": (
        lambda s: s["config"].update(overrides="os:abort"),
        "'os:abort'",
    ),
    "a class as config": (
        lambda s: s["config"].update(type="holiday.Loud"),
        "'holiday.Loud', which is no",
    ),
    "a class in the spec": (
        lambda s: s["spec"]["init"].update(type="holiday.Loud"),
        "'holiday.Loud', which is no",
    ),
    "a call in the spec": (
        lambda s: s["spec"].update(init={"type": "subprocess.Popen", "args": ["ls"]}),
        "'subprocess.Popen', which is no",
    ),
    "a module as representation": (
        lambda s: s.update(representation="holiday:run"),
        "no representation 'holiday:run'",
    ),
}


@pytest.mark.parametrize(
    ("kind", "command"),
    [
        *((kind, "render") for kind in HOSTILE),
        # All open a folder in the same way.
        *(("a motion beside it", one) for one in OPENING if one != "render"),
    ],
)
def test_no_command_runs_what_a_folder_names(
    kind, command, stranger, finished, capsys, monkeypatch
):
    change, words = HOSTILE[kind]
    edit(stranger / "config.json", change)
    monkeypatch.syspath_prepend(stranger)  # as `python -c` has it
    assert main(OPENING[command], stranger, finished) == 2
    assert ran(stranger) == []
    assert "holiday" not in sys.modules
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("error: ")
    assert re.search(words, said), said
    assert not list(stranger.rglob("frames.png"))


def test_code_that_is_named_again_is_loaded(stranger, finished, capsys):
    edit(stranger / "config.json", lambda s: s["spec"].update(motion=DRIFT))
    trusting = (*OPENING["export"], "--trust", "holiday:other", "holiday:Drift")
    main(trusting, stranger, finished)  # its checkpoint has no motion
    assert ran(stranger) == ["ran-import", "ran-motion"]
    assert sys.path[-1] == str(stranger)  # last: it may hold a jax.py as well


def test_a_run_opened_in_python_trusts_what_its_caller_names(stranger, monkeypatch):
    edit(stranger / "config.json", lambda s: s["spec"].update(motion=DRIFT))
    with pytest.raises(trust.UntrustedCode) as refused:
        runs.saved_run(stranger)
    assert refused.value.names == ("holiday:Drift",)
    assert "--" not in str(refused.value)
    with pytest.raises(runs.Refused, match="holiday:Drift"):
        runs.resume(stranger)
    assert ran(stranger) == []
    monkeypatch.syspath_prepend(stranger)
    opened = runs.saved_run(stranger, trusted=["holiday:Drift"])
    assert opened.spec.motion.learning_rate == 0.5
    assert opened.code == ("holiday:Drift",)


def test_only_a_module_that_is_not_found_elsewhere_is_looked_for_here(stranger):
    for name in ("numpy", "json", "absent_everywhere"):
        (stranger / f"{name}.py").write_text("")
    for name in ("json:x", "numpy.linalg:norm", "plain", ":x", "nowhere_at_all:x"):
        cli.find_code([name])
        assert str(stranger) not in sys.path
    cli.find_code(["absent_everywhere:x"])
    assert sys.path[-1] == str(stranger)


NOTES = {
    "an array of objects": lambda note: note.update(dtype="O"),
    "a key of a module": lambda note: note.update(key="holiday.Loud"),
    "a type of a module": lambda note: note.update(dtype="holiday.Loud"),
}


@pytest.mark.parametrize("kind", NOTES)
def test_a_checkpoint_names_no_code(kind, stranger, finished, capsys, monkeypatch):
    """Its notes may be a stranger's as well, with the right checksum."""
    monkeypatch.syspath_prepend(stranger)
    (stranger / "checkpoints").unlink()
    place = stranger / "checkpoints" / "0"
    source = finished / "run" / "checkpoints" / "0"
    for path in source.rglob("*"):
        if path.is_file():
            copied = place / path.relative_to(source)
            copied.parent.mkdir(parents=True, exist_ok=True)
            text = path.read_bytes()
            # What orbax keeps of the types of leaves, in a text of its own
            copied.write_bytes(text.replace(b'"jax.Array"', b'"holiday.Loud"'))
    about = json.loads((place / "about.json").read_text())
    NOTES[kind](next(iter(about["leaves"].values())))
    del about["crc32"]
    text = json.dumps(about, sort_keys=True)
    about["crc32"] = zlib.crc32(text.encode())
    (place / "about.json").write_text(json.dumps(about))
    assert main(OPENING["render"], stranger, finished) == 2
    assert re.search("cannot be read|unrecognized PRNG", capsys.readouterr().err)
    assert ran(stranger) == []


def test_a_model_file_names_no_code(stranger, finished, monkeypatch):
    monkeypatch.syspath_prepend(stranger)
    run = runs.saved_run(finished / "run")
    state, path = runs.restore(finished / "run", run).state, stranger / "model.npz"
    about = {"spec": run.spec, "metadata": run.metadata}
    model_file.save(path, state.params, about)
    with np.load(path) as file:
        content = dict(file)
    whole = json.loads(content[model_file.ABOUT].tobytes())
    for place in ("params", "description"):
        hostile = json.loads(json.dumps(whole))
        if place == "params":
            hostile["params"]["record"] = "holiday.Loud"
        else:
            hostile["description"]["spec"]["type"] = "holiday.Loud"
        text = np.frombuffer(json.dumps(hostile).encode(), np.uint8)
        np.savez(path, **content | {model_file.ABOUT: text})
        with pytest.raises(ValueError, match=r"'holiday\.Loud', which is no record"):
            model_file.load(path)
    assert ran(stranger) == []


def test_modules_of_the_current_folder_do_not_shadow_ours(tmp_path):
    """`python -m` puts a stranger's folder first on the path."""
    for name in ("jax", "numpy", "tyro", "nerfies_jax", "sitecustomize", "runpy"):
        mark = tmp_path / f"ran-{name}"
        (tmp_path / f"{name}.py").write_text(f"open({str(mark)!r}, 'w')")
    stored = tmp_path / "evil-1.0.dist-info"  # whose entry points would be loaded
    stored.mkdir()
    (stored / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0")
    points = "[nerfies_jax.representations]\nevil = numpy:evil\n"
    (stored / "entry_points.txt").write_text(points)
    (tmp_path / "config.json").write_text('{"representation": "evil"}')
    root = pathlib.Path(commands.__file__).resolve().parents[1]
    environment = dict(os.environ, PYTHONPATH=str(root), JAX_PLATFORMS="cpu")
    ended = subprocess.run(
        [sys.executable, "-m", "experiments.render", "."],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran(tmp_path) == []
    assert ended.returncode == 2, ended.stderr
    assert "no representation 'evil'" in ended.stderr
