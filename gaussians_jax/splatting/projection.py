"""EWA projection of Gaussians to the image, without cancellation.

A footprint is kept as its whitening instead of a conic. With dx, dy the offset of a
pixel from the mean,

    u = p dx,   v = r (dy - k dx),   exponent = u^2 + v^2 >= 0,

where p = 1/sqrt(2 a), k = b/a and r = 1/sqrt(2 (c - b^2/a)) for the dilated covariance
[[a, b], [b, c]] in px^2. A sum of squares cannot become negative. The quadratic form of
an inverse matrix does so in float32 for needles of about 3000 px.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from gaussians_jax.core.splats import Gaussians, refuse_half
from gaussians_jax.splatting import lens_jacobian
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.fusion import components
from nerfies_jax.geometry.jacobi import cross, dot
from nerfies_jax.geometry.precision import near_one
from nerfies_jax.runtime.contract import checked

# gsplat's MIN_COMPENSATION, squared: the antialiased opacity factor is at least 0.005.
MIN_COMPENSATION_SQ = 0.005**2
# px. Larger entries of T (see `project`) are treated as not finite, because their
# squares would overflow float32. Such a Gaussian has no visible shape.
MAX_EXTENT_PX = 1e16


class Footprints(NamedTuple):
    """Projected Gaussians of one camera, in the order of the Gaussians.

    A Gaussian that cannot be rendered (outside the near and far planes, opacity below
    the threshold, a zero quaternion, any NaN or infinity) has `extent_px` zero, finite
    placeholders in the other fields, and zero gradient.
    """

    mean_px: Float[Array, "gaussians 2"]  # x right, y down, pixel centers at +0.5
    whitening: Float[Array, "gaussians 3"]  # p 1/px, k px/px, r 1/px
    opacity: Float[Array, " gaussians"]  # with compensation if antialiased
    depth: Float[Array, " gaussians"]  # z, scene units
    extent_px: Float[
        Array, "gaussians 2"
    ]  # half box of alpha >= threshold, no gradient

    @property
    def visible(self) -> Bool[Array, " gaussians"]:
        """True for Gaussians that are rendered if their box overlaps the image."""
        return self.extent_px[:, 0] > 0

    def overlaps_image(self, size: tuple[int, int]) -> Bool[Array, " gaussians"]:
        """Select visible Gaussians whose box overlaps an image.

        Args:
          size: (width, height) of the image in pixels.

        Returns:
          True for the selected Gaussians.
        """
        low, high = self.mean_px - self.extent_px, self.mean_px + self.extent_px
        overlaps = (high > 0) & (low < jnp.asarray(size, low.dtype))
        return self.visible & jnp.all(overlaps, axis=1)


@checked
def project(
    gaussians: Gaussians, camera: Camera, size: tuple[int, int], spec: RasterSpec
) -> Footprints:
    """Project Gaussians to the image of one camera.

    Neither the 3D covariance nor its determinant is formed. The tangents x/z and y/z
    are clamped in J alone, to the image widened by `spec.tangent_margin` half images.

    With `spec.distorted`, or for a fisheye, J is the Jacobian of the projection through
    the lens. Gaussians centered where the lens has folded back, or less than 0.006
    degrees in front of the camera's plane, are not rendered. Otherwise the coefficients
    of the camera are not read.

    Args:
      gaussians: N Gaussians in world coordinates (scene units).
      camera: The camera. A fisheye is not clamped: its J is bounded.
      size: (width, height) of the image in pixels.
      spec: Near and far planes, dilation and thresholds.

    Returns:
      N footprints.

    References:
      Zwicker et al. 2002 (EWA splatting), equations 29 and 31: the covariance is T T^t
      + dilation with T = J W R diag(scale).
    """
    refuse_half(gaussians.mean.dtype)
    bounds = None
    if spec.distorted or camera.fisheye is not None:
        bounds = lens_jacobian.bounds(camera, size, spec.tangent_margin)

    def one(vectors, opacity):
        return _project_one(*vectors, opacity, camera, size, spec, bounds)

    # One array per component, so that operations use whole vectors.
    *vectors, opacity = gaussians
    columns = [components(rows) for rows in vectors]
    by_column = Footprints._make((1, 1, 0, 0, 1))
    footprints = jax.vmap(one, (0, 0), by_column)(columns, opacity)
    return footprints._replace(
        mean_px=footprints.mean_px.T,
        whitening=footprints.whitening.T,
        extent_px=footprints.extent_px.T,
    )


def _project_one(mean, quaternion, scale, opacity, camera, size, spec, bounds):
    """Project one Gaussian, whose vectors are given by their components."""
    # R (x - c), not R x + t: exact far from origin
    offset = [x - camera.position[i] for i, x in enumerate(mean)]
    depth = dot(camera.camera_from_world[2], offset)
    is_visible = (
        (depth >= spec.near) & (depth <= spec.far) & (opacity >= spec.alpha_threshold)
    )
    for part in (*offset, *quaternion, *scale, opacity):
        is_visible &= jnp.isfinite(part)
    largest = jnp.max(jnp.abs(jnp.stack(quaternion)))
    is_visible &= largest >= jnp.finfo(largest.dtype).tiny

    if bounds is not None:
        is_visible &= lens_jacobian.visible(offset, is_visible, camera)

    # `where` differentiates both branches: what is not drawn becomes a unit sphere one
    # unit ahead before anything is divided.
    ahead = camera.camera_from_world[2]
    offset = [jnp.where(is_visible, x, ahead[i]) for i, x in enumerate(offset)]
    quaternion = [jnp.where(is_visible, x, 1) for x in quaternion]
    scale = [jnp.where(is_visible, x, 1) for x in scale]
    opacity = jnp.where(is_visible, opacity, 0.5)

    if bounds is None:
        mean_px, depth, rows = _project_frame(offset, camera, size, spec)
    else:
        mean_px, depth, rows = lens_jacobian.project(offset, camera, bounds)
    first, second = _footprint_rows(rows, quaternion, scale)
    widest = jnp.max(jnp.abs(jnp.stack(first + second)))
    is_visible &= (widest < MAX_EXTENT_PX) & jnp.all(jnp.isfinite(mean_px))
    mean_px = jnp.where(is_visible, mean_px, 0)
    first = [jnp.where(is_visible, x, 0) for x in first]
    second = [jnp.where(is_visible, x, 0) for x in second]

    whitening, compensation = _whiten(first, second, spec)
    if spec.antialiased:
        opacity = opacity * compensation
        is_visible &= opacity >= spec.alpha_threshold
    extent = jnp.where(is_visible, _extent(whitening, opacity, spec), 0)
    fields = (
        jnp.where(is_visible, field, lax.stop_gradient(field))
        for field in (mean_px, whitening, opacity, depth)
    )
    return Footprints(*fields, lax.stop_gradient(extent))


def _project_frame(offset, camera, size, spec):
    """Return the mean in px, z, and the rows of J W (pixels per scene unit)."""
    width, height = size
    world = camera.camera_from_world
    x, y, z = dot(world[0], offset), dot(world[1], offset), dot(world[2], offset)
    focal_x = camera.focal_px
    focal_y = camera.focal_px * camera.pixel_aspect
    center_x, center_y = camera.principal_point_px
    tan_x, tan_y = x / z, y / z
    mean_px = jnp.stack(
        [
            focal_x * tan_x + camera.skew_px * tan_y + center_x,
            focal_y * tan_y + center_y,
        ]
    )
    tan_x = _clamp_tangent(tan_x, focal_x, center_x, width, spec)
    tan_y = _clamp_tangent(tan_y, focal_y, center_y, height, spec)
    across = -(focal_x * tan_x + camera.skew_px * tan_y)
    down = -focal_y * tan_y
    first = [
        (focal_x * world[0, i] + camera.skew_px * world[1, i] + across * world[2, i])
        / z
        for i in range(3)
    ]
    second = [(focal_y * world[1, i] + down * world[2, i]) / z for i in range(3)]
    return mean_px, z, (first, second)


def _clamp_tangent(tangent, focal, center, pixels, spec):
    margin = spec.tangent_margin * 0.5 * pixels
    return jnp.clip(
        tangent, -(center + margin) / focal, (pixels - center + margin) / focal
    )


def _footprint_rows(rows, quaternion, scale):
    """Return the two rows of T = J W R diag(scale) as lists of components."""
    # Scaled first, so that lengths of 1e-30 and 3e38 do not become 0 and infinity.
    w, x, y, z = components(near_one(jnp.stack(quaternion))[0])
    double = 2 / (w * w + x * x + y * y + z * z)
    columns = (
        (
            1 - double * (y * y + z * z),
            double * (x * y + w * z),
            double * (x * z - w * y),
        ),
        (
            double * (x * y - w * z),
            1 - double * (x * x + z * z),
            double * (y * z + w * x),
        ),
        (
            double * (x * z + w * y),
            double * (y * z - w * x),
            1 - double * (x * x + y * y),
        ),
    )
    return tuple([dot(row, columns[i]) * scale[i] for i in range(3)] for row in rows)


def _whiten(first, second, spec):
    """Return (p, k, r) and the antialiasing factor from the rows of T.

    c - b^2/a is a sum of squares, |t1 x t2|^2/a + dilation (1 + |t2|^2/a). t1 is scaled
    by 1/sqrt(a) first, to avoid products of fourth order in px.
    """
    dilation = spec.eps2d
    variance_x = dot(first, first) + dilation
    inverse = lax.rsqrt(variance_x)
    n = [x * inverse for x in first]
    area = cross(n, second)
    sharp_variance = dot(area, area)
    blurred_variance = sharp_variance + dilation * (
        1 + dot(second, second) / variance_x
    )
    shear = dot(n, second) * inverse
    half = jnp.sqrt(jnp.asarray(0.5, variance_x.dtype))
    whitening = jnp.stack([half * inverse, shear, half * lax.rsqrt(blurred_variance)])
    ratio = sharp_variance / blurred_variance
    small = ratio < MIN_COMPENSATION_SQ
    # The gradient of sqrt is infinite at 0, so the unused branch gets a 1.
    compensation = jnp.where(
        small, MIN_COMPENSATION_SQ**0.5, jnp.sqrt(jnp.where(small, 1, ratio))
    )
    return whitening, compensation


def _extent(whitening, opacity, spec):
    """Return half width and height (px) of the box where alpha >= threshold."""
    p, k, r = whitening
    reach = jnp.sqrt(jnp.maximum(jnp.log(opacity / spec.alpha_threshold), 0))
    across = reach / p
    # c = (c - b^2/a) + k^2 a
    down = jnp.hypot(reach / r, k * across)
    # Not zero, so that `visible` does not depend on rounding at the threshold.
    tiny = jnp.finfo(whitening.dtype).tiny
    return jnp.maximum(jnp.stack([across, down]), tiny)
