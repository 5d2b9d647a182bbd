"""The notebooks run to their end, and their own checks hold, made small."""

import importlib.util
import os
import pathlib
import re
import subprocess
import sys
import tomllib

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Constants of each, small. COLMAP finds the cameras of no fewer and smaller images;
# what is learned from them may be smaller.
SMALL = {
    "fit_an_image": {"GAUSSIANS": 300, "STEPS": 120, "WIDTH": 64},
    "own_motion": {"STEPS": 8, "SIZE": (48, 36), "FRAMES": 8},
    "own_nerf": {"STEPS": 500, "RAYS": 256, "WIDTH": 32, "SAMPLES": 16, "FACTOR": 4},
    "video_to_page": {
        "FRAMES": 14,
        "STEPS": 20,
        "PASSES": 1,
        "PRESET": "splats-static-small",
        "MAX_SIDE": 80,
    },
}


def test_every_notebook_is_run_somewhere():
    found = {path.stem for path in (ROOT / "docs/notebooks").glob("*.py")}
    assert found == {*SMALL}


@pytest.mark.parametrize("notebook", SMALL)
def test_colab_gets_a_notebook_that_installs_what_it_imports(notebook, tmp_path):
    pytest.importorskip("jupytext")
    nbformat = pytest.importorskip("nbformat")
    spec = importlib.util.spec_from_file_location("colab", ROOT / ".ci/notebooks.py")
    colab = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(colab)
    colab.main("https://github.com/owner/name/", tmp_path)
    made = nbformat.read(tmp_path / f"{notebook}.ipynb", as_version=4)
    nbformat.validate(made)
    first, *others = [cell.source for cell in made.cells if cell.cell_type == "code"]
    pattern = r'%pip install --quiet "nerfies-jax\[(.*)\] @ git\+(.*)"'
    extras, source = re.fullmatch(pattern, first).groups()
    assert source == "https://github.com/owner/name"
    assert not any(line.startswith("# %") for line in "\n".join(others).splitlines())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {"matplotlib": "report", "flax": "flax"}
    modules = set(re.findall(r"^(?:import|from) (\w+)", "\n".join(others), re.M))
    assert {needed[each] for each in modules & needed.keys()} <= {*extras.split(",")}
    assert {*extras.split(",")} <= project["optional-dependencies"].keys()
    target = colab.address("https://github.com/owner/name", notebook)
    assert target.endswith(f"/github/owner/name/blob/colab/{notebook}.ipynb")


@pytest.mark.slow
@pytest.mark.parametrize("notebook", SMALL)
def test_a_notebook_runs(notebook, tmp_path):
    path = ROOT / "docs/notebooks" / f"{notebook}.py"
    program = path.read_text()
    for name, value in SMALL[notebook].items():
        program, count = re.subn(
            rf"^{name} = [^#\n]*", f"{name} = {value!r}  ", program, flags=re.M
        )
        assert count == 1
    # Of several threads COLMAP finds other cameras on a busy machine: once it placed 8
    # of these 14 images.
    program = program.replace("passes=PASSES)", "passes=PASSES, threads=1)")
    assert ("threads=1" in program) == (notebook == "video_to_page")
    (tmp_path / path.name).write_text(program)
    folders = {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path), "MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, path.name],
        cwd=tmp_path,
        env=os.environ | folders,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
