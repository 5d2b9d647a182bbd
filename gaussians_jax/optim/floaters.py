"""Floaters: Gaussians close to a camera, or in the view of one camera only.

Nothing but the image of that camera determines them, so they represent what is only in
this image, such as a passer-by, a cloud or a change of the light, and hide the scene
from other viewpoints.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Splats
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.precision import exact_einsum


@dataclasses.dataclass(frozen=True)
class FloaterSpec:
    """Settings of the removal of floaters, at each event of the strategy.

    Attributes:
      near: Distance to a camera, relative to that of what it shows, below which a
        Gaussian in its view is removed. None disables the test.
      views: Number of cameras that a Gaussian has to be in the view of.
    """

    near: float | None = 0.2
    views: int = 2

    def __post_init__(self):
        if self.near is not None and not 0 < self.near < 1:
            raise ValueError(
                f"near={self.near} must lie between 0 and 1, the distance of the "
                "subject, or be None"
            )
        if self.views < 0:
            raise ValueError(f"views={self.views} must not be negative")


def find(
    spec: FloaterSpec, rows: Splats, cameras: Camera, size: tuple[int, int]
) -> Bool[np.ndarray, " gaussians"]:
    """Find the floaters of a static scene, on the host.

    Distances are z-depths. What a camera shows is at the median z-depth of the
    Gaussians in its view, weighted by their opacity. Lens distortion is ignored.

    Args:
      spec: Settings.
      rows: Raw parameters of the Gaussians.
      cameras: Cameras of the training frames, [frames].
      size: (width, height) of the images in pixels.

    Returns:
      True for floaters. Inactive Gaussians are none.
    """
    active = np.asarray(splats.active_mask(rows))
    depth, inside = map(np.asarray, _in_views(rows.mean, cameras, size))
    inside = inside & active
    floating = inside.sum(axis=0) < spec.views
    if spec.near is not None:
        opacity = np.asarray(splats.activate(rows).opacity)
        for own_depth, in_view in zip(depth, inside, strict=True):
            if in_view.any():
                subject = _weighted_median(own_depth[in_view], opacity[in_view])
                floating |= in_view & (own_depth < spec.near * subject)
    return floating & active


@functools.partial(jax.jit, static_argnames="size")
def _in_views(mean: Float[Array, "gaussians 3"], cameras: Camera, size):
    """Return z-depths [frames, gaussians], and whether means are in the images."""

    def one(camera):
        offset = mean - camera.position
        x, y, z = exact_einsum("ij,nj->in", camera.camera_from_world, offset)
        front = z > 0
        safe = jnp.where(front, z, 1)
        slope = x / safe, y / safe
        u = camera.focal_px * slope[0] + camera.skew_px * slope[1]
        v = camera.focal_px * camera.pixel_aspect * slope[1]
        u, v = u + camera.principal_point_px[0], v + camera.principal_point_px[1]
        width, height = size
        return z, front & (u >= 0) & (u < width) & (v >= 0) & (v < height)

    return jax.lax.map(one, cameras)


def _weighted_median(values, weights):
    order = np.argsort(values)
    below = np.cumsum(weights[order], dtype=np.float64)
    return values[order][np.searchsorted(below, below[-1] / 2)]
