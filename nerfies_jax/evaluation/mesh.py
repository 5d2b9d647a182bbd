"""A triangle mesh of a scene at one time, from its rendered depth.

Depth of the training views is fused to a truncated signed distance on a grid (Curless
and Levoy, SIGGRAPH 1996), whose zero level set is extracted by marching cubes.
"""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import plyfile

from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.evaluation import model_flow
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.runtime import events
from nerfies_jax.training.model import TrainState, View

VOXELS = 128  # along the longest side, by default
TRUNCATION = 4.0  # voxels
LEAST_ALPHA = 0.5  # of pixels that show a surface
MOST_VIEWS = 48
# Surfaces beyond these shares of the depth samples are background.
BOUNDS = (0.02, 0.98)


class Mesh(NamedTuple):
    """Triangles with vertex colors."""

    vertices: np.ndarray  # [vertices, 3], scene units
    faces: np.ndarray  # [faces, 3] int, counterclockwise from outside
    colors: np.ndarray  # [vertices, 3] uint8


class _Observed(NamedTuple):
    """A rendered pinhole view."""

    camera: cameras.Camera
    depth: np.ndarray  # [height, width], 0 without a surface
    color: np.ndarray  # [height, width, 3]


def extract(
    draw: Draw, state: TrainState, views: Sequence[View], voxels: int = VOXELS
) -> Mesh:
    """Fuse the depth of views to a mesh.

    Args:
      draw: Renderer.
      state: Trained state.
      views: Pinhole views of one time.
      voxels: Number of voxels along the longest side of the scene.

    Returns:
      The mesh.

    Raises:
      ValueError: If the views show no surface.
    """
    import skimage.measure

    observed = [_observed(draw, state, view) for view in views]
    low, high = _bounds(observed)
    step = float((high - low).max()) / voxels
    sides = np.ceil((high - low) / step).astype(int) + 1
    axes = [low[axis] + step * np.arange(side) for axis, side in enumerate(sides)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = jnp.asarray(points, jnp.float32)
    total = jnp.zeros((len(points), 5), jnp.float32)
    with events.stage("fusing depth", len(observed)) as stage:
        for one in observed:
            total = _integrate(total, points, one, TRUNCATION * step)
            stage.advance()
    sums = np.asarray(total)
    weight = sums[:, 0]
    mean = sums[:, 1:] / np.maximum(weight, 1e-9)[:, None]
    distance = np.where(weight > 0, mean[:, 0], 1).reshape(sides)
    color = mean[:, 1:].reshape(*sides, 3)
    seen = (weight > 0).reshape(sides)
    if not ((distance < 0) & seen).any() or not ((distance > 0) & seen).any():
        raise ValueError(
            "the depth of the training views shows no surface; train for more steps"
        )
    vertices, faces, _, _ = skimage.measure.marching_cubes(
        distance, 0.0, mask=seen, gradient_direction="ascent"
    )
    if not len(faces):
        raise ValueError(
            "the depth of the training views shows no surface; train for more steps"
        )
    nearest = np.clip(np.rint(vertices).astype(int), 0, sides - 1)
    bytes_of = np.rint(np.clip(color[tuple(nearest.T)], 0, 1) * 255).astype(np.uint8)
    return Mesh(low + step * vertices, faces.astype(np.int32), bytes_of)


def _observed(draw, state, view):
    rendering = draw(state, view)
    alpha = np.asarray(rendering.alpha)
    depth = np.where(alpha >= LEAST_ALPHA, np.asarray(rendering.depth), 0)
    depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    camera = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), view.camera)
    return _Observed(camera, depth, np.asarray(rendering.color, np.float32))


def _bounds(observed):
    """Corners of the box of the surfaces that the views show."""
    points = []
    for one in observed:
        down, right = np.nonzero(one.depth)
        chosen = np.linspace(0, max(0, len(down) - 1), min(len(down), 2000)).astype(int)
        pixels = np.stack([right[chosen], down[chosen]], axis=-1) + 0.5
        depth = one.depth[down, right][chosen]
        points.append(model_flow.surface(one.camera, pixels, depth))
    points = np.concatenate(points)
    if not len(points):
        raise ValueError(
            "the depth of the training views shows no surface; train for more steps"
        )
    low, high = np.quantile(points, BOUNDS, axis=0)
    margin = 0.05 * (high - low).max()
    return low - margin, high + margin


@jax.jit
def _integrate(total, points, one, truncation):
    """Add a view to the sums of weights, distances and colors of all points."""
    height, width = one.depth.shape
    pixel, z = jax.vmap(lambda point: cameras.project(one.camera, point))(points)
    place = jnp.floor(pixel)
    inside = (place >= 0).all(-1) & (place < jnp.array([width, height])).all(-1)
    right, down = jnp.where(inside[:, None], place, 0).astype(int).T
    depth = one.depth[down, right]
    distance = depth - z
    # Points behind a surface by more than the truncation are hidden from this view.
    valid = inside & (z > 0) & (depth > 0) & (distance > -truncation)
    value = jnp.minimum(distance / truncation, 1)
    # Colors are of surfaces, and not of the free space in front of them.
    terms = jnp.concatenate([value[:, None], one.color[down, right]], axis=-1)
    terms = jnp.concatenate([jnp.ones_like(z)[:, None], terms], axis=-1)
    return total + jnp.where(valid[:, None], terms, 0)


def write(path: pathlib.Path, mesh: Mesh) -> None:
    """Write a PLY file with vertex colors.

    Args:
      path: The file.
      mesh: The mesh.
    """
    vertex = np.empty(
        len(mesh.vertices),
        [(axis, "<f4") for axis in "xyz"]
        + [(color, "u1") for color in ("red", "green", "blue")],
    )
    for column, axis in enumerate("xyz"):
        vertex[axis] = mesh.vertices[:, column]
    for column, color in enumerate(("red", "green", "blue")):
        vertex[color] = mesh.colors[:, column]
    face = np.empty(len(mesh.faces), [("vertex_indices", "<i4", (3,))])
    face["vertex_indices"] = mesh.faces
    elements = [
        plyfile.PlyElement.describe(vertex, "vertex"),
        plyfile.PlyElement.describe(face, "face"),
    ]
    with replaced_file(path) as partial:
        plyfile.PlyData(elements, byte_order="<").write(str(partial))
