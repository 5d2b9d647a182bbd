"""A room reads only lower floors, and most tests do so too; modules form no circles."""

import ast
import graphlib
import pathlib

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Longest prefix wins. gaussians_jax reads floors 1-5 of nerfies_jax, experiments all.
FLOORS = {
    "nerfies_jax.contract": 1,
    "nerfies_jax.geometry": 1,
    "nerfies_jax.children": 1,
    "nerfies_jax.compiler": 1,
    "nerfies_jax.console": 1,
    "nerfies_jax.progress": 1,
    "nerfies_jax.events": 1,
    "nerfies_jax.processes": 1,
    "nerfies_jax.stopping": 1,
    "nerfies_jax.data_parallel": 1,
    "nerfies_jax.nets": 2,
    "nerfies_jax.capture": 3,
    "nerfies_jax.training": 4,
    "nerfies_jax.measure": 5,
    "nerfies_jax.measure.matrix_flops": 3,  # of a traced program; reads `nets` alone
    "nerfies_jax.evaluation": 5,
    "nerfies_jax.evidence": 5,
    "nerfies_jax.radiance": 6,
    "nerfies_jax.effects": 7,
    "nerfies_jax.scene_metadata": 5,  # of a capture; reads nothing else
    "nerfies_jax.spec": 8,
    "nerfies_jax.field_ray": 8,
    "nerfies_jax.render_ray": 8,
    "nerfies_jax.occupied_rays": 8,
    "nerfies_jax.frustum_grid": 8,
    "nerfies_jax.skipping": 8,
    "nerfies_jax.field": 8,
    "nerfies_jax.scene": 8,
    "nerfies_jax.held_out_codes": 8,
    "nerfies_jax.path_fit": 8,
    "nerfies_jax.point_tracks": 8,
    "nerfies_jax.step_time": 8,
    "nerfies_jax.variants": 8,
    "nerfies_jax.presets": 8,
    "nerfies_jax.representation": 8,
    "nerfies_jax.runs": 9,
    "nerfies_jax": 10,  # the face of the package
    "gaussians_jax.effects": 7,
    "gaussians_jax.losses": 8,
    "gaussians_jax.motion": 8,
    "gaussians_jax.strategy": 8,
    "gaussians_jax.spec": 8,
    "gaussians_jax.first_state": 8,
    "gaussians_jax.growth": 8,
    "gaussians_jax.model_file": 8,
    "gaussians_jax.held_out_exposure": 8,
    "gaussians_jax.scene": 8,
    "gaussians_jax.track_start": 8,
    "gaussians_jax.track_fitting": 8,
    "gaussians_jax.point_tracks": 8,
    "gaussians_jax.step_time": 8,
    "gaussians_jax.update": 8,
    "gaussians_jax.browser_splats": 8,
    "gaussians_jax.variants": 8,
    "gaussians_jax.presets": 8,
    "gaussians_jax.small_presets": 8,
    "gaussians_jax.representation": 8,
    "gaussians_jax": 6,
    "experiments": 11,
}
OURS = ("nerfies_jax", "gaussians_jax", "experiments")
# Folders of tests read their room and lower ones, `tests/gaussians` what gaussians_jax
# may. What is not named here (evaluation, evidence, runs, hard cases) takes scenes of
# both packages and reads both; only `tests/experiments` reads experiments.
TESTED = {
    "geometry": 1,
    "nets": 2,
    "capture": 3,
    "training": 4,
    "measure": 5,
    "radiance": 8,
    "effects": 8,
}


def floor(module):
    best = max(
        (room for room in FLOORS if (module + ".").startswith(room + ".")), key=len
    )
    return FLOORS[best], best.split(".")[0], best


def imports(path):
    """Names of modules read by a file, with whether at its top level."""
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
        level, package, room = floor(module)
        for name, _ in imports(path):
            if name.split(".")[0] not in OURS:
                continue
            other_level, other_package, other_room = floor(name)
            across = package != other_package and package != "experiments"
            if across and not (package == "gaussians_jax" and 1 <= other_level <= 5):
                yield f"{module} reads {name}"
            elif other_level > level and room != "nerfies_jax":
                yield f"{module} (floor {level}) reads {other_room} ({other_level})"


def violations_of_tests(root):
    for path in sorted((root / "tests").rglob("*.py")):
        folder = path.relative_to(root / "tests").parts[0]
        for name, _ in imports(path):
            package = name.split(".")[0]
            if package not in OURS or folder == "experiments":
                continue
            if package == "experiments":
                yield f"{path}: reads {name}; only tests/experiments may"
                continue
            level, other, _ = floor(name)
            if folder in TESTED and (other != "nerfies_jax" or level > TESTED[folder]):
                yield f"{path}: reads {name}, above its room"
            elif folder == "gaussians" and other == "nerfies_jax" and level > 5:
                yield f"{path}: reads {name}, which gaussians_jax may not"


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


def test_rooms_read_only_lower_floors():
    assert list(violations(ROOT)) == []


def test_tests_read_their_room_and_lower_ones():
    assert list(violations_of_tests(ROOT)) == []


def test_no_modules_import_each_other():
    assert circle(ROOT) == []


FAULTS = {
    "nerfies_jax/geometry/lie.py": "from nerfies_jax.training import loop\n",
    "gaussians_jax/raster.py": "import nerfies_jax.scene\n",
    "tests/nets/test_mlp.py": "from nerfies_jax.training import loop\n",
    "tests/gaussians/test_files.py": "from experiments import cli\n",
    "tests/gaussians/test_scene.py": "import nerfies_jax.scene\n",
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
