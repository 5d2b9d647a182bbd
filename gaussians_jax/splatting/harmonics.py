"""View-dependent color: real spherical harmonics of degree 0 to 3."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.geometry.precision import near_one

_C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)
MAX_DEGREE = 3


def degree_of(coefficients: int) -> int:
    """Return the degree that has this many coefficients: 1, 4, 9 or 16.

    Args:
      coefficients: Number of coefficients per color channel.

    Returns:
      The degree, 0 to 3.

    Raises:
      ValueError: If no degree has this number.
    """
    degree = math.isqrt(coefficients) - 1
    if not 0 <= degree <= MAX_DEGREE or (degree + 1) ** 2 != coefficients:
        raise ValueError(
            f"spherical harmonics need 1, 4, 9 or 16 coefficients, got {coefficients}"
        )
    return degree


def unit_direction(offset: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Normalize vectors. Zero and non-finite vectors give +z without a gradient.

    A vector is first scaled by its largest component, so that directions of 1e-30 and
    3e38 are accurate in float32.

    Args:
      offset: Vectors of any length.

    Returns:
      Unit vectors.
    """
    largest = jnp.max(jnp.abs(offset), axis=-1, keepdims=True)
    limits = jnp.finfo(offset.dtype)
    is_valid = (largest >= limits.tiny) & (largest <= limits.max)  # False for NaN
    axis = jnp.asarray([0, 0, 1], offset.dtype)
    scaled_offset, _ = near_one(jnp.where(is_valid, offset, axis), axis=-1)
    return scaled_offset / jnp.linalg.norm(scaled_offset, axis=-1, keepdims=True)


def basis(
    direction: Float[Array, "*n 3"], degree: int
) -> tuple[Float[Array, "*n"], ...]:
    """Evaluate the (degree + 1)^2 basis functions, as separate arrays.

    Signs and order are those of 3D Gaussian splatting (with the Condon-Shortley phase:
    the first degree is -y, z, -x).

    Args:
      direction: Unit vectors.
      degree: Degree of the harmonics, at most 3.

    Returns:
      Values of the basis functions.
    """
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    terms = [jnp.full_like(x, _C0)]
    if degree >= 1:
        terms += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        terms += [
            _C2[0] * x * y,
            -_C2[0] * y * z,
            _C2[1] * (2 * zz - xx - yy),
            -_C2[0] * x * z,
            _C2[2] * (xx - yy),
        ]
    if degree >= 3:
        terms += [
            -_C3[0] * y * (3 * xx - yy),
            _C3[1] * x * y * z,
            -_C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -_C3[2] * x * (4 * zz - xx - yy),
            _C3[4] * z * (xx - yy),
            -_C3[0] * x * (xx - 3 * yy),
        ]
    return tuple(terms)


def color_toward(
    coefficients: Float[Array, "*n coefficients 3"],
    mean: Float[Array, "*n 3"],
    camera_position: Float[Array, "3"],
) -> Float[Array, "*n 3"]:
    """Evaluate spherical harmonics toward a camera: max(SH + 1/2, 0).

    Args:
      coefficients: Coefficients, whose number (1, 4, 9 or 16) implies the degree.
      mean: Means of the Gaussians, in world coordinates.
      camera_position: Camera center, in world coordinates.

    Returns:
      Colors, at least zero.
    """
    degree = degree_of(coefficients.shape[-2])
    terms = basis(unit_direction(mean - camera_position), degree)
    total = sum(
        term[..., None] * coefficients[..., i, :] for i, term in enumerate(terms)
    )
    return jnp.maximum(total + 0.5, 0)
