"""A room reads only rooms on lower floors, and nothing reads upwards."""

import ast
import pathlib

ROOT = pathlib.Path(__file__).resolve().parents[1]
# Longest prefix wins. gaussians_jax reads floors 1-5 of nerfies_jax, experiments all.
FLOORS = {
    "nerfies_jax.geometry": 1,
    "nerfies_jax.nets": 2,
    "nerfies_jax.capture": 3,
    "nerfies_jax.training": 4,
    "nerfies_jax.measure": 5,
    "nerfies_jax.radiance": 6,
    "nerfies_jax.effects": 7,
    "nerfies_jax.scene_metadata": 8,
    "nerfies_jax.spec": 8,
    "nerfies_jax.render_ray": 8,
    "nerfies_jax.field": 8,
    "nerfies_jax.scene": 8,
    "nerfies_jax.presets": 9,
    "nerfies_jax": 0,
    "gaussians_jax.effects": 7,
    "gaussians_jax.spec": 8,
    "gaussians_jax.scene": 8,
    "gaussians_jax.presets": 9,
    "gaussians_jax": 6,
    "experiments": 10,
}


def floor(module):
    best = max(
        (room for room in FLOORS if (module + ".").startswith(room + ".")), key=len
    )
    return FLOORS[best], best.split(".")[0], best


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            for alias in node.names:
                yield f"{node.module}.{alias.name}"


def violations(root):
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        if parts[0] not in {"nerfies_jax", "gaussians_jax", "experiments"}:
            continue
        module = ".".join(part for part in parts if part != "__init__")
        level, package, _ = floor(module)
        for name in imports(path):
            if name.split(".")[0] not in {
                "nerfies_jax",
                "gaussians_jax",
                "experiments",
            }:
                continue
            other_level, other_package, other_room = floor(name)
            across = package != other_package and package != "experiments"
            if across and not (package == "gaussians_jax" and 1 <= other_level <= 5):
                yield f"{module} reads {name}"
            elif other_level > level:
                yield f"{module} (floor {level}) reads {other_room} ({other_level})"


def test_rooms_read_only_lower_floors():
    assert list(violations(ROOT)) == []


def test_an_upward_import_is_caught(tmp_path):
    package = tmp_path / "nerfies_jax" / "geometry"
    package.mkdir(parents=True)
    (package / "lie.py").write_text("from nerfies_jax.training import loop\n")
    (tmp_path / "gaussians_jax").mkdir()
    (tmp_path / "gaussians_jax" / "raster.py").write_text("import nerfies_jax.scene\n")
    assert len(list(violations(tmp_path))) == 2
