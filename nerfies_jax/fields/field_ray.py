"""Rays in units of the field, and the distances of their samples."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.fields import occupancy, sampling
from nerfies_jax.fields.spec import CENTER, RadianceScene
from nerfies_jax.geometry import rays
from nerfies_jax.geometry.camera import Camera

Vector = Float[Array, "3"]
Scalar = Float[Array, ""]

LOOKS = 64  # points along a ray at which occupancy is read, as many as cells


class Ray(NamedTuple):
    """One ray in units of the field."""

    origin: Vector
    direction: Vector  # unit length
    near: Scalar  # distance
    far: Scalar


def field_ray(
    metadata: SceneMetadata, origin: Vector, direction: Vector, cosine: Scalar
) -> Ray:
    """Convert a ray to the coordinates of the field, between the near and far planes.

    The planes are at constant z-depth, so oblique rays have larger distances.

    Args:
      metadata: Scene metadata.
      origin: Origin in scene units, [3].
      direction: Unit direction, [3].
      cosine: z-depth per distance along the ray.

    Returns:
      The ray in units of the field.
    """
    center = jnp.asarray(metadata.center, origin.dtype)
    span = metadata.scale / cosine
    return Ray(
        (origin - center) * metadata.scale,
        direction,
        metadata.near * span,
        metadata.far * span,
    )


def field_ray_through(
    metadata: SceneMetadata, camera: Camera, pixel: Float[Array, "2"]
) -> tuple[Ray, Scalar]:
    """Return the ray of a pixel in units of the field.

    Args:
      metadata: Scene metadata.
      camera: The camera.
      pixel: Position (x, y) with centers at +0.5, [2].

    Returns:
      The ray, and its z-depth per distance.
    """
    ray = rays.pixel_ray(camera, pixel)
    cosine = rays.depth_per_distance(camera, ray.direction)
    return field_ray(metadata, ray.origin, ray.direction, cosine), cosine


def filled_along(
    cells: occupancy.Cells, ray: Ray, half_side: float
) -> Bool[Array, " looks"]:
    """Look up the occupancy at the middles of `LOOKS` equal parts of a ray.

    Args:
      cells: Occupied cells.
      ray: The ray in units of the field.
      half_side: Half side of the grid in units of the field.

    Returns:
      Booleans [LOOKS], True in an occupied cell or outside of the grid.
    """
    share = (jnp.arange(LOOKS, dtype=ray.near.dtype) + 0.5) / LOOKS
    distance = ray.near + (ray.far - ray.near) * share
    point = ray.origin + distance[:, None] * ray.direction
    return occupancy.at(cells, point, half_side)


def first_distances(
    spec: RadianceScene,
    ray: Ray,
    key: Key[Array, ""] | None,
    guide: occupancy.Cells | None,
) -> Float[Array, " coarse"]:
    """Sample distances for the first level.

    They are uniform, dense in the captured volume, or mostly in occupied cells.

    Args:
      spec: The scene.
      ray: The ray in units of the field.
      key: PRNG key, or None.
      guide: Occupied cells, or None for uniform samples.

    Returns:
      Sorted distances, [coarse].
    """
    plan = spec.sampling
    if plan.spacing == CENTER:
        assert spec.extent is not None
        # Field coordinates have their origin at the center of the volume.
        middle = -jnp.sum(ray.origin * ray.direction)
        miss_sq = jnp.sum(jnp.square(ray.origin + middle * ray.direction))
        width = jnp.sqrt(spec.extent**2 + miss_sq)
        return sampling.sample_around(
            key, ray.near, ray.far, plan.coarse, middle, width
        )
    if guide is None:
        return sampling.stratified(key, ray.near, ray.far, plan.coarse, plan.spacing)
    assert spec.extent is not None
    assert plan.occupancy is not None
    # Equal parts for any spacing, because cells are of equal size.
    is_occupied = filled_along(guide, ray, spec.extent)
    empty = plan.occupancy.empty
    return sampling.among(key, ray.near, ray.far, is_occupied, plan.coarse, empty)


def fine_distances(
    spec: RadianceScene,
    metadata: SceneMetadata,
    coarse: Float[Array, " coarse"],
    new: Float[Array, " fine"],
) -> Float[Array, " samples"]:
    """Combine the distances of the fine level.

    They are all distances or only the new ones, depending on the spec. If the last
    coarse sample represents everything behind it, it is always included. Otherwise the
    last new sample, which lies on a surface, would also represent the background.

    Args:
      spec: The scene.
      metadata: Scene metadata.
      coarse: Sorted distances of the coarse level, [coarse].
      new: Sorted new distances, [fine].

    Returns:
      Sorted distances, [samples].
    """
    if spec.sampling.union:
        return sampling.union(coarse, new)
    if metadata.background is None:
        return jnp.concatenate([new, coarse[-1:]])
    return new
