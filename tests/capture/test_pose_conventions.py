"""Poses of transforms.json in other conventions are recognized from the points."""

import json

import numpy as np
import plyfile
import pytest

from nerfies_jax.capture import blender_format
from nerfies_jax.capture.capture import CaptureError
from tests.capture.test_blender_format import dump, make

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
CONVENTIONS = {
    "camera to world .* right, down, forward": lambda pose: pose @ FLIP,
    "world to camera .* right, down, forward": lambda pose: np.linalg.inv(pose @ FLIP),
    "world to camera .* right, up, back": np.linalg.inv,
}


def with_points(root, convert, shift=0.0):
    make(root, {"": 6}, top={"fl_x": 9.0, "ply_file_path": "a.ply"})
    file = root / "transforms.json"
    table = json.loads(file.read_text())
    for entry in table["frames"]:
        entry["transform_matrix"] = convert(
            np.array(entry["transform_matrix"])
        ).tolist()
    dump(file, table)
    rows = np.random.default_rng(0).uniform(-1, 1, (200, 3)) + shift
    vertex = np.array([tuple(row) for row in rows], [(axis, "<f4") for axis in "xyz"])
    plyfile.PlyData([plyfile.PlyElement.describe(vertex, "vertex")]).write(
        str(root / "a.ply")
    )
    return root


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_another_convention_is_named(convention, tmp_path):
    with_points(tmp_path, CONVENTIONS[convention])
    with pytest.raises(CaptureError, match=f"transform_matrix is {convention}"):
        blender_format.read(tmp_path)


@pytest.mark.parametrize(("shift", "doubtful"), [(0.0, False), (1e4, True)])
def test_points_of_another_world_have_a_note(shift, doubtful, tmp_path):
    with_points(tmp_path, np.array, [0, 0, shift])
    notes = blender_format.read(tmp_path).notes
    assert any("of another world" in note for note in notes) == doubtful
    assert any(note.startswith("no points in view") for note in notes) == doubtful
