"""Projection through a lens, and its Jacobian at one point.

The Jacobian is that of the distorted projection, so without distortion the footprint of
a Gaussian is that of a pinhole, and models trained through a lens look the same in
pinhole renders. The unscented transform of 3DGUT (Wu et al. 2025, arXiv:2412.12507) has
neither property, and costs seven projections for each Gaussian.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry import fisheye, lens
from nerfies_jax.geometry.camera import MAX_SLOPE, Camera
from nerfies_jax.geometry.jacobi import dot

# Corners and midpoints of the border of an image, in half images from its center.
_BORDER = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y])


class Bounds(NamedTuple):
    """Undistorted tangents at which the Jacobian is taken, at least and at most."""

    low: Float[Array, "2"]
    high: Float[Array, "2"]


class LinearLens(NamedTuple):
    """Distortion of the image plane to first order, at one point (x, y)."""

    bent: tuple[Float[Array, ""], Float[Array, ""]]  # distorted position
    xx: Float[Array, ""]  # Jacobian of the distorted position, which is symmetric
    xy: Float[Array, ""]
    yy: Float[Array, ""]
    along: tuple[Float[Array, ""], Float[Array, ""]]  # the Jacobian times (x, y)


def bounds(camera: Camera, size: tuple[int, int], margin: float) -> Bounds:
    """Bound the tangents x/z and y/z in the Jacobian to a widened image.

    Args:
      camera: One camera.
      size: Width and height of the image in pixels.
      margin: Width of the rim that is added on each side, in half images.

    Returns:
      The undistorted tangents that bound it.
    """
    dtype = camera.principal_point_px.dtype
    if camera.fisheye is not None:  # its Jacobian is bounded by itself
        most = jnp.full(2, MAX_SLOPE, dtype)
        return Bounds(-most, most)
    half = jnp.asarray(size, dtype) / 2
    border = half * (1 + (1 + margin) * jnp.asarray(_BORDER, dtype))
    offset = border - camera.principal_point_px
    y = offset[:, 1] / (camera.focal_px * camera.pixel_aspect)
    # Without the skew, as for a pinhole.
    x = offset[:, 0] / camera.focal_px
    # Where the lens shows no point of the border, the last that it shows.
    tangents, _ = jax.vmap(lambda point: lens.undistort(camera, point))(
        jnp.stack([x, y], axis=1)
    )
    return Bounds(jnp.min(tangents, axis=0), jnp.max(tangents, axis=0))


def visible(
    offset: list[Float[Array, ""]], ahead: Bool[Array, ""], camera: Camera
) -> Bool[Array, ""]:
    """Test if the lens is one-to-one at a point, which it is not beyond its fold.

    Args:
      offset: Components of a point relative to the camera, in world axes.
      ahead: True if the point is in front of the camera.
      camera: One camera.

    Returns:
      A boolean scalar.
    """
    world = lax.stop_gradient(camera.camera_from_world)
    x, y, z = (dot(world[i], [lax.stop_gradient(c) for c in offset]) for i in range(3))
    z = jnp.where(ahead, z, 1)
    near_axis = ahead & (jnp.abs(x) < MAX_SLOPE * z) & (jnp.abs(y) < MAX_SLOPE * z)
    tangents = jnp.stack([jnp.where(near_axis, x, 0), jnp.where(near_axis, y, 0)]) / z
    return near_axis & lens.one_to_one(lax.stop_gradient(camera), tangents)


def project(
    offset: list[Float[Array, ""]], camera: Camera, bounds: Bounds
) -> tuple[Float[Array, "2"], Float[Array, ""], tuple[list, list]]:
    """Project one point through the lens, with its Jacobian.

    Args:
      offset: Components of the point relative to the camera, in world axes.
      camera: One camera.
      bounds: Tangents at which the Jacobian is taken at least and at most.

    Returns:
      The pixel, the z-depth, and the two rows of the Jacobian with respect to the point
      in world axes, in pixels per scene unit.
    """
    world = camera.camera_from_world
    x, y, z = (dot(world[i], offset) for i in range(3))
    x, y = x / z, y / z
    focal_x, focal_y = camera.focal_px, camera.focal_px * camera.pixel_aspect
    bent_x, bent_y = _linearize(camera, x, y).bent
    pixel = jnp.stack([focal_x * bent_x + camera.skew_px * bent_y, focal_y * bent_y])
    near = _linearize(
        camera,
        jnp.clip(x, bounds.low[0], bounds.high[0]),
        jnp.clip(y, bounds.low[1], bounds.high[1]),
    )
    # K D (x, y), with D the Jacobian of the distortion.
    right = focal_x * near.xx + camera.skew_px * near.xy
    cross = focal_x * near.xy + camera.skew_px * near.yy
    ahead = focal_x * near.along[0] + camera.skew_px * near.along[1]
    first = [
        (right * world[0, i] + cross * world[1, i] - ahead * world[2, i]) / z
        for i in range(3)
    ]
    second = [
        focal_y
        * (near.xy * world[0, i] + near.yy * world[1, i] - near.along[1] * world[2, i])
        / z
        for i in range(3)
    ]
    return pixel + camera.principal_point_px, z, (first, second)


def _linearize(camera: Camera, x: Float[Array, ""], y: Float[Array, ""]) -> LinearLens:
    """Distort one point of the image plane, with the Jacobian of the distortion."""
    radius_sq = x * x + y * y
    if camera.fisheye is not None:
        ratio, change, along = fisheye.stretch(camera.fisheye, radius_sq)
        xx, xy, yy = (2 * change * product for product in (x * x, x * y, y * y))
        return LinearLens(
            (x * ratio, y * ratio), ratio + xx, xy, ratio + yy, (x * along, y * along)
        )
    k1, k2, k3 = (camera.radial[i] for i in range(3))
    p1, p2 = camera.tangential[0], camera.tangential[1]
    ratio = 1 + radius_sq * (k1 + radius_sq * (k2 + radius_sq * k3))
    change = 2 * (k1 + radius_sq * (2 * k2 + radius_sq * 3 * k3))
    distorted_point = (
        x * ratio + 2 * p1 * x * y + p2 * (radius_sq + 2 * x * x),
        y * ratio + 2 * p2 * x * y + p1 * (radius_sq + 2 * y * y),
    )
    xx = ratio + change * x * x + 2 * p1 * y + 6 * p2 * x
    xy = change * x * y + 2 * p1 * x + 2 * p2 * y
    yy = ratio + change * y * y + 2 * p2 * x + 6 * p1 * y
    return LinearLens(distorted_point, xx, xy, yy, (xx * x + xy * y, xy * x + yy * y))
