"""A package imports only from the layers below it, and modules form no circles."""

import ast
import functools
import graphlib
import pathlib

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
# From the lowest layer up. `nerfies_jax` and `gaussians_jax` themselves stand for the
# modules beside their packages: the public names and the `Representation`.
LAYERS = (
    "nerfies_jax.runtime",
    "nerfies_jax.geometry",
    "nerfies_jax.nn",
    "nerfies_jax.capture",
    "nerfies_jax.training",
    "nerfies_jax.visualization",
    "nerfies_jax.metrics",
    "nerfies_jax.preprocessing",
    "nerfies_jax.evaluation",
    "nerfies_jax.runs",
    "nerfies_jax.fields",
    "nerfies_jax.scene",
    "nerfies_jax",
    "gaussians_jax.core",
    "gaussians_jax.splatting",
    "gaussians_jax.optim",
    "gaussians_jax.init",
    "gaussians_jax.motion",
    "gaussians_jax.losses",
    "gaussians_jax.per_frame",
    "gaussians_jax.scene",
    "gaussians_jax.io",
    "gaussians_jax.player",
    "gaussians_jax",
    "experiments",
)
OURS = ("nerfies_jax", "gaussians_jax", "experiments")
# The two representations and the runs of any of them do not know each other.
SHARED = LAYERS[: LAYERS.index("nerfies_jax.runs")]
# Tests of a package import that package and lower ones. What is not named here
# (evaluation, preprocessing, runs, hard cases) takes scenes of both representations.
TESTED = {
    "geometry": "nerfies_jax.geometry",
    "nn": "nerfies_jax.nn",
    "capture": "nerfies_jax.capture",
    "training": "nerfies_jax.training",
    "metrics": "nerfies_jax.metrics",
    "visualization": "nerfies_jax.visualization",
    "fields": "nerfies_jax.scene",
    "gaussians": "gaussians_jax",
}


def layer(module):
    """Return the package of a module, or of a name in a module."""
    return max((p for p in LAYERS if (module + ".").startswith(p + ".")), key=len)


def readable(package):
    """Return the packages that a package may import from, besides itself."""
    below = LAYERS[: LAYERS.index(package)]
    root = package.split(".")[0]
    if package == "experiments":
        return below
    if package == "nerfies_jax":  # public names
        return [p for p in below if p.startswith(root)]
    if package in SHARED or package == "nerfies_jax.runs":
        return below
    own = [p for p in below if p.startswith(root + ".") and p != "nerfies_jax.runs"]
    return [*SHARED, *own]


@functools.cache
def imports(path):
    """Names of modules read by a file, with whether at its top level."""
    return list(_imports(path))


def _imports(path):
    tree = ast.parse(path.read_text())
    inner = {
        id(node)
        for outer in ast.walk(tree)
        if isinstance(outer, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(outer)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, id(node) not in inner
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            for alias in node.names:
                yield f"{node.module}.{alias.name}", id(node) not in inner


def modules(root):
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        if parts[0] in OURS:
            yield ".".join(part for part in parts if part != "__init__"), path


def violations(root):
    for module, path in modules(root):
        package = layer(module)
        for name, _ in imports(path):
            if name.split(".")[0] in OURS:
                other = layer(name)
                if other != package and other not in readable(package):
                    yield f"{module} imports {name}"


def violations_of_tests(root):
    for path in sorted((root / "tests").rglob("*.py")):
        folder = path.relative_to(root / "tests").parts[0]
        for name, _ in imports(path):
            if name.split(".")[0] not in OURS or folder == "experiments":
                continue
            other = layer(name)
            if other == "experiments":
                yield f"{path}: imports {name}; only tests/experiments may"
            elif folder in TESTED:
                package = TESTED[folder]
                if other != package and other not in readable(package):
                    yield f"{path}: imports {name}, above its package"


def circle(root):
    """Modules that import each other when they are loaded; empty where none do."""
    known = dict(modules(root))
    graph = {}
    for module, path in known.items():
        read = set()
        for name, at_load in imports(path):
            if not at_load:
                continue
            if name not in known:  # a name of a module: the module is what is read
                name = name.rpartition(".")[0]
            # A package's face may load what is in it; that is not read back by name.
            if name in known and name != module and not module.startswith(f"{name}."):
                read.add(name)
        graph[module] = read
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def test_packages_import_from_lower_layers():
    assert list(violations(ROOT)) == []


def test_tests_import_their_package_and_lower_ones():
    assert list(violations_of_tests(ROOT)) == []


def test_no_modules_import_each_other():
    assert circle(ROOT) == []


FAULTS = {
    "nerfies_jax/geometry/lie.py": "from nerfies_jax.training import loop\n",
    "gaussians_jax/splatting/raster.py": "import nerfies_jax.scene.scene\n",
    "tests/nn/test_mlp.py": "from nerfies_jax.training import loop\n",
    "tests/gaussians/test_files.py": "from experiments import cli\n",
    "tests/gaussians/test_scene.py": "import nerfies_jax.scene.scene\n",
}


@pytest.mark.parametrize("name", FAULTS)
def test_an_upward_import_is_caught(name, tmp_path):
    path = tmp_path / name
    path.parent.mkdir(parents=True)
    path.write_text(FAULTS[name])
    assert [*violations(tmp_path), *violations_of_tests(tmp_path)]


def test_a_circle_is_caught(tmp_path):
    room = tmp_path / "nerfies_jax" / "geometry"
    room.mkdir(parents=True)
    (room / "lie.py").write_text("from nerfies_jax.geometry import rays\n")
    (room / "rays.py").write_text("from nerfies_jax.geometry.lie import log\n")
    assert circle(tmp_path)
