"""One ray in units of the field, and where along it the field is asked."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from nerfies_jax.geometry import rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.radiance import occupancy, sampling
from nerfies_jax.scene_metadata import SceneMetadata
from nerfies_jax.spec import RadianceScene

Vector = Float[Array, "3"]
Scalar = Float[Array, ""]

LOOKS = 64  # at the cells along a ray, as many as there are across


class Ray(NamedTuple):
    """One ray in units of the field."""

    origin: Vector
    direction: Vector  # unit length
    near: Scalar  # distance
    far: Scalar


def field_ray(
    metadata: SceneMetadata, origin: Vector, direction: Vector, cosine: Scalar
) -> Ray:
    """A ray of the scene in the field's coordinates, between the near and far planes.

    The planes are z-depths, so a slanted ray is sampled further out.
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
    """The field's ray through one pixel position, and its z-depth per distance."""
    ray = rays.pixel_ray(camera, pixel)
    cosine = rays.depth_per_distance(camera, ray.direction)
    return field_ray(metadata, ray.origin, ray.direction, cosine), cosine


def filled_along(
    cells: occupancy.Cells, ray: Ray, half_side: float
) -> Bool[Array, " looks"]:
    """Whether a ray is in a filled cell, or beyond them, in the middle of each of
    `LOOKS` even parts.
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
    """Where the first level is asked: all along the ray, or mostly in filled cells."""
    plan = spec.sampling
    if guide is None:
        return sampling.stratified(key, ray.near, ray.far, plan.coarse, plan.spacing)
    # Even parts whatever the spacing: cells are even.
    filled = filled_along(guide, ray, spec.extent)
    empty = plan.occupancy.empty
    return sampling.among(key, ray.near, ray.far, filled, plan.coarse, empty)


def fine_distances(
    spec: RadianceScene,
    metadata: SceneMetadata,
    coarse: Float[Array, " coarse"],
    drawn: Float[Array, " fine"],
) -> Float[Array, " samples"]:
    """Where the fine level is asked: at all distances, or at those drawn alone.

    The last coarse sample is among them in any case where it stands for all behind it:
    drawn where a surface is, the last one would hold the background behind its back.
    """
    if spec.sampling.union:
        return sampling.union(coarse, drawn)
    if metadata.background is None:
        return jnp.concatenate([drawn, coarse[-1:]])
    return drawn
