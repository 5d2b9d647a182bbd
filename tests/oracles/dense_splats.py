"""Every Gaussian at every pixel in float64: the textbook renderer, for autodiff.

Forms the 3D covariance, the 2D covariance and its inverse, sorts by a stable argsort
and composites by cumulative products. Shares no code or formula layout with the
package, and costs memory pixels x Gaussians.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Image(NamedTuple):
    color: jax.Array  # [height, width, channels]
    alpha: jax.Array  # [height, width]
    depth: jax.Array  # sum of w z, not divided


def rotation(quaternion):
    w, x, y, z = quaternion / jnp.linalg.norm(quaternion)
    return jnp.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def footprint(mean, quaternion, scale, camera, size, spec):
    """Mean (px), 2D covariance before dilation, z."""
    width, height = size
    here = camera.camera_from_world @ (mean - camera.position)
    x, y, z = here
    intrinsics = jnp.array(
        [
            [camera.focal_px, camera.skew_px, camera.principal_point_px[0]],
            [0, camera.focal_px * camera.pixel_aspect, camera.principal_point_px[1]],
            [0, 0, 1],
        ]
    )
    mean_px = (intrinsics @ (here / z))[:2]

    def limit(tangent, focal, center, pixels):
        slack = spec.tangent_margin * pixels / (2 * focal)
        return jnp.clip(
            tangent, -center / focal - slack, (pixels - center) / focal + slack
        )

    tx = limit(x / z, intrinsics[0, 0], intrinsics[0, 2], width)
    ty = limit(y / z, intrinsics[1, 1], intrinsics[1, 2], height)
    perspective = jnp.array([[1 / z, 0, -tx / z], [0, 1 / z, -ty / z]])
    jacobian = intrinsics[:2, :2] @ perspective @ camera.camera_from_world
    turned = rotation(quaternion)
    covariance = turned @ jnp.diag(scale**2) @ turned.T
    return mean_px, jacobian @ covariance @ jacobian.T, z


def opacities_and_conics(covariance, opacity, spec):
    dilated = covariance + spec.eps2d * jnp.eye(2)
    if spec.antialiased:
        ratio = jnp.linalg.det(covariance) / jnp.linalg.det(dilated)
        small = ratio < 0.005**2
        opacity = opacity * jnp.where(
            small, 0.005, jnp.sqrt(jnp.where(small, 1, ratio))
        )
    return opacity, jnp.linalg.inv(dilated)


def composite(mean_px, conic, opacity, depth, values, size, spec):
    """[pixels, channels] and transmittance [pixels] of already visible Gaussians."""
    width, height = size
    rows, columns = jnp.arange(0.5, height), jnp.arange(0.5, width)
    y, x = jnp.meshgrid(rows, columns, indexing="ij")
    pixel = jnp.stack([x.ravel(), y.ravel()], axis=-1)
    order = jnp.argsort(depth, stable=True)
    offset = pixel[:, None] - mean_px[order]
    exponent = jnp.einsum("pni,nij,pnj->pn", offset, conic[order], offset) / 2
    raw = opacity[order] * jnp.exp(-exponent)
    if spec.clamp_gradient == "zero":
        alpha = jnp.minimum(raw, spec.alpha_max)
    else:
        alpha = raw + jax.lax.stop_gradient(jnp.minimum(raw, spec.alpha_max) - raw)
    alpha = jnp.where((raw >= spec.alpha_threshold) & (opacity[order] > 0), alpha, 0)
    passed = jnp.cumprod(1 - alpha, axis=1)
    before = jnp.concatenate([jnp.ones_like(passed[:, :1]), passed[:, :-1]], axis=1)
    blended = passed > spec.transmittance_threshold
    weight = jnp.where(blended, alpha * before, 0)
    left = jnp.prod(jnp.where(blended, 1 - alpha, 1), axis=1)
    return weight @ values[order], left


def render(gaussians, values, camera, size, spec, mean2d_offset=None):
    mean_px, covariance, depth = jax.vmap(
        lambda m, q, s: footprint(m, q, s, camera, size, spec)
    )(gaussians.mean, gaussians.quaternion, gaussians.scale)
    if mean2d_offset is not None:
        mean_px = mean_px + mean2d_offset
    opacity, conic = jax.vmap(lambda c, o: opacities_and_conics(c, o, spec))(
        covariance, gaussians.opacity
    )
    seen = (depth >= spec.near) & (depth <= spec.far)
    opacity = jnp.where(seen, opacity, 0)
    values = jnp.concatenate([values, depth[:, None]], axis=1)
    image, left = composite(mean_px, conic, opacity, depth, values, size, spec)
    width, height = size
    image = image.reshape(height, width, -1)
    left = left.reshape(height, width)
    return Image(image[..., :-1], 1 - left, image[..., -1])
