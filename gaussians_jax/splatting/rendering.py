"""Rendering of one frame from one camera: color, alpha, depth, features."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gaussians_jax.core.splats import Gaussians
from gaussians_jax.splatting import bands, harmonics, projection
from gaussians_jax.splatting.projection import Footprints
from gaussians_jax.splatting.raster_spec import GSPLAT, RasterSpec
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.precision import widened
from nerfies_jax.runtime.contract import checked
from nerfies_jax.training.model import Rendering

# Expected depth is D / max(alpha, 1e-10) as in gsplat, zero and not NaN without
# Gaussians.
LEAST_ALPHA = 1e-10


class Frame(NamedTuple):
    """Result of one pass over the Gaussians."""

    rendering: Rendering
    footprints: Footprints
    features: Float[Array, "height width features"] | None  # without background


@checked
def render(
    gaussians: Gaussians,
    colors: Float[Array, "gaussians 3"],
    camera: Camera,
    size: tuple[int, int],
    spec: RasterSpec = GSPLAT,
    background: Float[Array, "*image 3"] | None = None,
    features: Float[Array, "gaussians features"] | None = None,
    mean2d_offset: Float[Array, "gaussians 2"] | None = None,
    depth: bool = True,
    devices: int = 1,
) -> Frame:
    """Render Gaussians from one camera.

    `rasterization` takes other numbers of channels, and several cameras.

    Args:
      gaussians: N Gaussians in world coordinates.
      colors: Colors [N, 3].
      camera: One camera. Its radial and tangential distortion is modeled with
        `spec.distorted`.
      size: (width, height) of the image in pixels.
      spec: Thresholds and tile sizes.
      background: One color [3] or an image [height, width, 3] behind the Gaussians.
        None is black.
      features: Further values [N, F], rendered without a background.
      mean2d_offset: Shift of the projected means in pixels, [N, 2]. Pass zeros: their
        gradient is that of the projected means, which densification compares with a
        threshold.
      depth: Whether to render the expected depth. Without it a training step takes
        4 % less time.
      devices: Number of devices that rasterize the image, in horizontal bands.

    Returns:
      The rendering, the projected Gaussians, and the rendered features.

    Raises:
      ValueError: An array has another shape, or the camera has lens distortion without
        `spec.distorted`. The distortion of a traced camera cannot be checked
        (`_refuse_distortion` on the host).
    """
    if not (spec.distorted or isinstance(camera.radial, jax.core.Tracer)):
        _refuse_distortion(camera)
    footprints = projection.project(gaussians, camera, size, spec)
    offset_footprints = footprints
    if mean2d_offset is not None:
        offset_footprints = footprints._replace(
            mean_px=footprints.mean_px + mean2d_offset
        )
    values = [widened(colors)]
    if depth:
        values.append(footprints.depth[:, None])
    if features is not None:
        values.append(widened(features))
    image, transmittance = bands.rasterize(
        offset_footprints, jnp.concatenate(values, axis=1), size, spec, devices
    )
    color, alpha = image[..., :3], 1 - transmittance
    if background is not None:
        color = color + background * transmittance[..., None]
    expected_depth = image[..., 3] / jnp.maximum(alpha, LEAST_ALPHA) if depth else None
    extras = None if features is None else image[..., 4 if depth else 3 :]
    return Frame(Rendering(color, alpha, expected_depth), footprints, extras)


@checked
def render_harmonics(
    gaussians: Gaussians,
    coefficients: Float[Array, "gaussians coefficients 3"],
    camera: Camera,
    size: tuple[int, int],
    spec: RasterSpec = GSPLAT,
    background: Float[Array, "*image 3"] | None = None,
    features: Float[Array, "gaussians features"] | None = None,
    mean2d_offset: Float[Array, "gaussians 2"] | None = None,
    depth: bool = True,
    devices: int = 1,
) -> Frame:
    """Render Gaussians with colors from spherical harmonics.

    Args:
      gaussians: N Gaussians in world coordinates.
      coefficients: 1, 4, 9 or 16 coefficients for each Gaussian and channel.
      camera: One camera.
      size: (width, height) of the image in pixels.
      spec: Settings of the rasterizer.
      background: Color behind the Gaussians, as in `render`.
      features: Further values, as in `render`.
      mean2d_offset: Shift of the projected means, as in `render`.
      depth: Whether to render the expected depth.
      devices: Number of devices, as in `render`.

    Returns:
      The rendering, the projected Gaussians, and the rendered features.
    """
    colors = harmonics.color_toward(coefficients, gaussians.mean, camera.position)
    extras = background, features, mean2d_offset, depth, devices
    return render(gaussians, colors, camera, size, spec, *extras)


def _refuse_distortion(camera: Camera) -> None:
    """Raise where `camera` (host values) has radial or tangential distortion."""
    for name in ("radial", "tangential"):
        value = np.asarray(getattr(camera, name))
        if np.any(value != 0):
            raise ValueError(
                f"the camera has lens distortion, {name}={value.tolist()}, which "
                "these settings ignore; set RasterSpec.distorted=True, or undistort "
                "the images"
            )
