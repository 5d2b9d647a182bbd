"""Rotations in three dimensions as 3x3 matrices.

Leading axes of all arguments broadcast. A rotation vector is the axis times the angle,
in radians. Half-precision arguments are computed in float32 and rounded once. Every
function is differentiable to any order, also at the identity.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.geometry import lie
from nerfies_jax.geometry.precision import at_least_float32, exact_product
from nerfies_jax.runtime.contract import checked

Vector = Float[Array, "3"]
Matrix = Float[Array, "3 3"]


@checked(broadcast=True)
def exp(rotation_vector: Vector) -> Matrix:
    """Compute the rotation matrix of a rotation vector.

    Args:
      rotation_vector: Axis times angle in radians, [..., 3]. The turn is as exact as
        the angle: to 6e-8 of it in float32. Angles above 1e19 rad overflow float32.

    Returns:
      Rotation matrices [..., 3, 3] that act on column vectors from the left.

    References:
      Rodrigues' formula in Stumpff functions of the squared angle.
    """
    return lie.exp_so3(rotation_vector)


@checked(broadcast=True)
def log(rotation: Matrix) -> Vector:
    """Compute the rotation vector of a rotation matrix.

    Args:
      rotation: Rotation matrices [..., 3, 3].

    Returns:
      Axis times angle [..., 3], with angles of at most pi radians.
    """
    return lie.log_so3(rotation)


@checked(broadcast=True)
def apply(rotation: Matrix, point: Vector) -> Vector:
    """Rotate points.

    Args:
      rotation: Rotation matrices [..., 3, 3].
      point: Points or directions [..., 3].

    Returns:
      Rotated points [..., 3].
    """
    return _product(rotation, point)


@checked(broadcast=True)
def multiply(second: Matrix, first: Matrix) -> Matrix:
    """Compose two rotations: the result applies `first`, then `second`.

    Args:
      second: Rotation matrices [..., 3, 3].
      first: Rotation matrices [..., 3, 3].

    Returns:
      The products `second @ first`, [..., 3, 3].
    """
    return _product(second, first)


@checked(broadcast=True)
def inverse(rotation: Matrix) -> Matrix:
    """Invert a rotation, which is to transpose it.

    Args:
      rotation: Rotation matrices [..., 3, 3].

    Returns:
      Their transposes [..., 3, 3].
    """
    return rotation.T


@checked(broadcast=True)
def left_jacobian(rotation_vector: Vector) -> Matrix:
    """Compute the left Jacobian of the exponential map.

    Args:
      rotation_vector: Axis times angle in radians, [..., 3].

    Returns:
      J [..., 3, 3] with exp(w + d) = exp(J d) exp(w) to first order in d.
    """
    return lie.left_jacobian(rotation_vector)


@checked(broadcast=True)
def inverse_left_jacobian(rotation_vector: Vector) -> Matrix:
    """Compute the inverse of the left Jacobian of the exponential map.

    Args:
      rotation_vector: Axis times angle in radians, [..., 3], for angles below 2 pi,
        where the Jacobian is singular.

    Returns:
      The inverse of `left_jacobian`, [..., 3, 3].
    """
    return lie.inverse_left_jacobian(rotation_vector)


@checked(broadcast=True)
def hat(vector: Vector) -> Matrix:
    """Compute the skew-symmetric matrix of a vector.

    Args:
      vector: Vectors w, [..., 3].

    Returns:
      Matrices [w] with [w] x = w × x, [..., 3, 3].
    """
    return lie.hat(vector)


def identity(dtype: jnp.dtype | type = jnp.float32) -> Matrix:
    """Make the identity rotation.

    Args:
      dtype: Floating-point type of the result.

    Returns:
      The 3x3 identity matrix.
    """
    return jnp.eye(3, dtype=dtype)


@at_least_float32
def _product(left, right):
    return exact_product(left, right)
