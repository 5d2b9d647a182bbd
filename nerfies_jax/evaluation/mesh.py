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
import scipy.ndimage

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
NO_SURFACE = "the depth of the training views shows no surface; train for more steps"


class Mesh(NamedTuple):
    """Triangles with vertex colors."""

    vertices: np.ndarray  # [vertices, 3], scene units
    faces: np.ndarray  # [faces, 3] int, counterclockwise from outside
    colors: np.ndarray  # [vertices, 3] uint8


class _Observation(NamedTuple):
    """A rendered pinhole view."""

    camera: cameras.Camera
    depth: np.ndarray  # [height, width], infinity without a surface
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

    observations = [_observe(draw, state, view) for view in views]
    low, high = _bounds(observations)
    step = float((high - low).max()) / voxels
    sides = np.ceil((high - low) / step).astype(int) + 1
    axes = [low[axis] + step * np.arange(side) for axis, side in enumerate(sides)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = jnp.asarray(grid, jnp.float32)
    total = jnp.zeros((len(points), 6), jnp.float32)
    with events.stage("fusing depth", len(observations)) as stage:
        for observation in observations:
            total = _integrate(total, points, observation, TRUNCATION * step)
            stage.advance()
    sums = np.asarray(total)
    weight, shade = sums[:, 0], sums[:, 2:3]
    distance = np.where(weight > 0, sums[:, 1] / np.maximum(weight, 1e-9), 1)
    distance = distance.reshape(sides)
    color = (sums[:, 3:] / np.maximum(shade, 1e-9)).reshape(*sides, 3)
    # All neighbors are seen, since unseen space has no sign: a surface between it and
    # the inside would be no surface of the scene.
    in_view = (weight > 0).reshape(sides)
    in_view = scipy.ndimage.binary_erosion(in_view, np.ones((3, 3, 3)))
    if not ((distance < 0) & in_view).any() or not ((distance > 0) & in_view).any():
        raise ValueError(NO_SURFACE)
    vertices, faces, _, _ = skimage.measure.marching_cubes(
        distance, 0.0, mask=in_view, gradient_direction="descent"
    )
    if not len(faces):
        raise ValueError(NO_SURFACE)
    nearest = np.clip(np.rint(vertices).astype(int), 0, sides - 1)
    bytes_of = np.rint(np.clip(color[tuple(nearest.T)], 0, 1) * 255).astype(np.uint8)
    return Mesh(low + step * vertices, faces.astype(np.int32), bytes_of)


def _observe(draw, state, view):
    rendering = draw(state, view)
    alpha = np.asarray(rendering.alpha)
    depth = np.asarray(rendering.depth, np.float32)
    # A ray that hits nothing passes through free space.
    depth = np.where((alpha >= LEAST_ALPHA) & np.isfinite(depth), depth, np.inf)
    camera = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), view.camera)
    return _Observation(camera, depth, np.asarray(rendering.color, np.float32))


def _bounds(observations):
    """Corners of the box of the surfaces that the views show."""
    points = []
    for observation in observations:
        down, right = np.nonzero(np.isfinite(observation.depth))
        sample = np.linspace(0, max(0, len(down) - 1), min(len(down), 2000)).astype(int)
        pixels = np.stack([right[sample], down[sample]], axis=-1) + 0.5
        depth = observation.depth[down, right][sample]
        points.append(model_flow.surface(observation.camera, pixels, depth))
    points = np.concatenate(points)
    if not len(points):
        raise ValueError(NO_SURFACE)
    low, high = np.quantile(points, BOUNDS, axis=0)
    margin = 0.05 * (high - low).max()
    return low - margin, high + margin


@jax.jit
def _integrate(total, points, observation, truncation):
    """Add a view to the weighted sums of all points, of distances and of colors."""
    height, width = observation.depth.shape
    pixel, z = jax.vmap(lambda point: cameras.project(observation.camera, point))(
        points
    )
    place = jnp.floor(pixel)
    size = jnp.asarray([width, height], place.dtype)
    inside = (place >= 0).all(-1) & (place < size).all(-1)
    right, down = jnp.where(inside[:, None], place, 0).astype(int).T
    depth = observation.depth[down, right]
    distance = depth - z
    # Points behind a surface by more than the truncation are hidden from this view.
    valid = inside & (z > 0) & (distance > -truncation)
    value = jnp.minimum(distance / truncation, 1)
    # Behind a surface the weight falls: at a silhouette what is seen is in front of
    # something else.
    weight = jnp.where(valid, jnp.minimum(1 + value, 1), 0)
    # Colors are those of surfaces, and not of the free space in front of them.
    shade = jnp.where(value < 1, weight, 0)
    parts = [weight, weight * value, shade]
    parts = [part[:, None] for part in parts]
    return total + jnp.concatenate(
        [*parts, shade[:, None] * observation.color[down, right]], axis=-1
    )


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
