"""Commands whose output is read no further, or lost, do all of their work.

And what they show on a terminal meanwhile.
"""

import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile

import pytest

from nerfies_jax import runs
from nerfies_jax.capture import nerfies_format
from tests import event_checks, scenes

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="pipes of a shell"),
]

ROOT = pathlib.Path(__file__).resolve().parents[2]
RECONSTRUCT = ("--preset", "splats-static-small", "--steps", "12")
RECONSTRUCT += ("--set", "strategy=none", "sh_degree=0", "init.extra_random=0")


def command(name, *words, output=""):
    """Exit code of a command whose output goes where a shell sends it."""
    words = [sys.executable, "-m", "experiments", name, *map(str, words)]
    redirected, bar, reader = output.partition("|")
    script = f'{{ "$@" {redirected}; echo $? > "$0"; }} {bar} {reader}'
    with tempfile.NamedTemporaryFile("r") as code:
        subprocess.run(
            ["sh", "-c", script, code.name, *words],
            cwd=ROOT,
            capture_output=True,
            check=True,
            env=environment(),
        )
        return int(code.read())


def environment():
    import jax

    cache = jax.config.jax_compilation_cache_dir
    return {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache, "JAX_PLATFORMS": "cpu"}


def files(folder):
    """Names of all files of a run, but for those of its trackers and checkpoints."""
    paths = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {str(path) for path in paths if "checkpoints" not in path.parts}


def check_whole(folder, undisturbed):
    assert files(folder) == files(undisturbed)
    one, other = (
        json.loads((path / "metrics.json").read_text())
        for path in (folder, undisturbed)
    )
    assert one["heldout.psnr"] == other["heldout.psnr"]
    steps = [sorted((x / "checkpoints").iterdir()) for x in (folder, undisturbed)]
    assert [each.name for each in steps[0]] == [each.name for each in steps[1]]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A run on a terminal, and what the terminal shows."""
    folder = tmp_path_factory.mktemp("output")
    nerfies_format.write(scenes.tiny_capture(), folder / "capture")
    words = ("reconstruct", folder / "capture", *RECONSTRUCT, "--out", folder / "run")
    return folder / "run", on_terminal(*words)


def on_terminal(*words):
    """Everything that a command writes on a terminal of its own."""
    controller, terminal = os.openpty()
    words = [sys.executable, "-m", "experiments", *map(str, words)]
    sized = {"TERM": "xterm-256color", "COLUMNS": "160", "LINES": "50"}
    process = subprocess.Popen(
        words,
        cwd=ROOT,
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        env=environment() | sized,
    )
    os.close(terminal)
    shown = b""
    while True:
        try:
            read = os.read(controller, 65536)
        except OSError:  # Linux: the other end is closed
            break
        if not read:
            break
        shown += read
    os.close(controller)
    assert process.wait() == 0, shown.decode()[-2000:]
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.decode())


def test_a_terminal_shows_each_stage_that_lasts_by_name(undisturbed):
    folder, shown = undisturbed
    events = runs.read_events(folder)
    names = event_checks.ended_stages(events)
    expected = ["reading images", "building the model", "initializing the scene"]
    expected += ["compiling the renderer", "training", "scoring held-out frames"]
    expected += ["making the player", "rendering the video", "measuring quality"]
    assert [each for each in dict.fromkeys(names) if each in expected] == expected
    seconds = {
        one["name"]: one["seconds"]
        for one in events
        if one["kind"] == "stage" and "seconds" in one
    }
    # A shorter stage would only flicker, and how long each lasts is the machine's.
    lasting = [name for name in seconds if seconds[name] > 1]
    assert lasting
    assert all(name in shown for name in lasting)
    assert "report:" in shown


def test_a_reconstruction_completes_whatever_reads_it(undisturbed, tmp_path):
    """A reader that goes away is no failure; a full disk, below, is one."""
    whole, _ = undisturbed
    words = (whole.parent / "capture", *RECONSTRUCT, "--out", tmp_path / "run")
    assert command("reconstruct", *words, output="2>&1 | head -1") == 0
    check_whole(tmp_path / "run", whole)


def test_a_resumed_run_completes_whatever_reads_it(undisturbed, tmp_path):
    whole, _ = undisturbed
    folder = shutil.copytree(whole, tmp_path / "run")
    for name in ("metrics.json", "report.html", "scene.mp4", "model.npz"):
        (folder / name).unlink()
    shutil.rmtree(folder / "checkpoints" / "12")
    words = ("--out", folder, "--resume")
    assert command("reconstruct", *words, output=">/dev/full 2>&1") == 1
    check_whole(folder, whole)


@pytest.mark.parametrize(("output", "code"), [("| true", 1), ("2>&-", 0)])
def test_a_document_that_is_lost_is_a_failure(output, code, undisturbed, tmp_path):
    whole, _ = undisturbed
    out = tmp_path / "ply"
    words = (whole, "ply", "--out", out.with_suffix(".ply"), "--json")
    assert command("export", *words, output=output) == code
    assert out.with_suffix(".ply").stat().st_size > 1000
