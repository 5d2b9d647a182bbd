"""A mesh of rendered depth."""

import jax
import numpy as np
import plyfile
import pytest

import nerfies_jax as nj
from nerfies_jax.evaluation import mesh
from nerfies_jax.training.model import Rendering, TrainState, View

SIZE = (64, 48)
pixel_rays = jax.jit(lambda camera: nj.pixel_rays(camera, SIZE))
STATE = TrainState((), (), (), np.int32(0), jax.random.key(0))
RADIUS, CENTER = 0.8, np.array([0.3, -0.2, 0.1])


def ball(state, view):
    """Depth and color of a sphere, which is red above the middle and green below."""
    camera = view.camera
    rays = pixel_rays(camera)
    origin = np.asarray(rays.origin, float) - CENTER
    direction = np.asarray(rays.direction, float)
    half = (origin * direction).sum(-1)
    root = half**2 - (origin**2).sum(-1) + RADIUS**2
    hit = root > 0
    distance = -half - np.sqrt(np.where(hit, root, 0))
    point = origin + distance[..., None] * direction
    depth = distance * (direction @ np.asarray(camera.camera_from_world)[2])
    color = np.where(point[..., 2:] > 0, [0.9, 0, 0], [0, 0.6, 0])
    return Rendering(color, hit.astype(float), np.where(hit, depth, np.nan))


def around(count=10):
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    for angle, height in zip(angles, np.tile([-1.5, 1.5], count), strict=False):
        away = np.array([2.5 * np.cos(angle), 2.5 * np.sin(angle), height])
        place = CENTER + away
        camera = nj.look_at(place, CENTER, (0, 0, 1), 60.0, SIZE)
        yield View(camera, np.float32(0), np.int32(0))


def test_a_sphere_comes_back_closed_with_its_colors(tmp_path):
    extracted = mesh.extract(ball, STATE, list(around()), voxels=40)
    step = 1.1 * 2 * RADIUS / 40
    offset = extracted.vertices - CENTER
    radius = np.linalg.norm(offset, axis=1)
    assert abs(radius - RADIUS).max() < step
    assert abs(radius.mean() - RADIUS) < 0.2 * step
    # Triangles turn counterclockwise from outside: the volume is positive.
    a, b, c = (offset[extracted.faces[:, k]] for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.05)
    above = offset[:, 2] > 5 * step  # beyond the truncation
    np.testing.assert_array_equal(extracted.colors[above, 1], 0)
    assert (extracted.colors[above, 0] > 150).all()
    mesh.write(tmp_path / "a.ply", extracted)
    ply = plyfile.PlyData.read(tmp_path / "a.ply")
    assert len(ply["vertex"]) == len(extracted.vertices)
    faces = np.stack(ply["face"]["vertex_indices"])
    np.testing.assert_array_equal(faces, extracted.faces)


def test_views_without_a_surface_are_refused():
    def empty(state, view):
        return Rendering(np.zeros((48, 64, 3)), np.zeros((48, 64)), np.ones((48, 64)))

    with pytest.raises(ValueError, match="shows no surface; train for more steps"):
        mesh.extract(empty, STATE, list(around(2)))
