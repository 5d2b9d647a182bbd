"""Poses of transforms.json in other conventions are recognized from the points."""

import numpy as np
import plyfile
import pytest

from nerfies_jax.capture import formats
from nerfies_jax.capture.capture import CaptureError
from tests.capture.broken import edited
from tests.capture.test_blender_format import make

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
CONVENTIONS = {
    "camera to world .* right, down, forward": lambda pose: pose @ FLIP,
    "world to camera .* right, down, forward": lambda pose: np.linalg.inv(pose @ FLIP),
    "world to camera .* right, up, back": np.linalg.inv,
}


def with_points(root, convert, shift=0.0):
    make(root, {"": 6}, top={"fl_x": 9.0, "ply_file_path": "a.ply"})
    with edited(root / "transforms.json") as table:
        for entry in table["frames"]:
            pose = np.array(entry["transform_matrix"])
            entry["transform_matrix"] = convert(pose).tolist()
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
        formats.load(tmp_path)


def test_points_of_another_world_are_refused(tmp_path):
    with_points(tmp_path / "a", np.array, [0, 0, 1e4])
    with pytest.raises(CaptureError, match="points or the poses are probably in other"):
        formats.load(tmp_path / "a")
    assert formats.load(with_points(tmp_path / "b", np.array)).points is not None
