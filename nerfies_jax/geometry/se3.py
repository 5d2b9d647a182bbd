"""Rigid transforms in three dimensions as 4x4 matrices, and their twists.

Leading axes of all arguments broadcast. A twist is (angular, linear): axis times angle
in radians, then the linear part in scene units, as the screw axis (r, v) of Nerfies
(Park et al. 2021, arXiv:2011.12948, equations 9 and 11). jaxlie has the linear part
first. The linear part is not the translation, which is `so3.left_jacobian(angular) @
linear`. Half-precision arguments are computed in float32 and rounded once. Every
function is differentiable to any order, also at the identity.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.geometry import lie
from nerfies_jax.geometry.precision import at_least_float32, exact_product
from nerfies_jax.runtime.contract import checked

Twist = Float[Array, "6"]
Transform = Float[Array, "4 4"]
Vector = Float[Array, "3"]


@checked(broadcast=True)
@at_least_float32
def exp(twist: Twist) -> Transform:
    """Compute the rigid transform of a twist.

    Args:
      twist: (angular, linear) in radians and scene units, [..., 6].

    Returns:
      Homogeneous matrices [..., 4, 4] with last row (0, 0, 0, 1).
    """
    return from_rotation_translation(*lie.exp_se3(twist[:3], twist[3:]))


@checked(broadcast=True)
@at_least_float32
def log(transform: Transform) -> Twist:
    """Compute the twist of a rigid transform.

    Args:
      transform: Rigid transforms [..., 4, 4]; the last row is not read.

    Returns:
      (angular, linear) [..., 6], with angles of at most pi radians. It inverts `exp`
      for angles below pi.
    """
    return jnp.concatenate(lie.log_se3(transform[:3, :3], transform[:3, 3]))


@checked(broadcast=True)
@at_least_float32
def apply(transform: Transform, point: Vector) -> Vector:
    """Move points by a rigid transform.

    Args:
      transform: Rigid transforms [..., 4, 4]; the last row is not read.
      point: Points in scene units, [..., 3].

    Returns:
      R x + t, [..., 3].
    """
    return exact_product(transform[:3, :3], point) + transform[:3, 3]


@checked(broadcast=True)
def apply_twist(twist: Twist, point: Vector) -> Vector:
    """Move points along a twist without forming a matrix.

    It equals `apply(exp(twist), point)` and is cheaper where each point has its own
    twist.

    Args:
      twist: (angular, linear) in radians and scene units, [..., 6].
      point: Points in scene units, [..., 3].

    Returns:
      The moved points [..., 3].
    """
    return lie.transform_point(twist[:3], twist[3:], point)


@checked(broadcast=True)
def displacement(twist: Twist, point: Vector) -> Vector:
    """Compute how far a twist moves points, without cancellation.

    Args:
      twist: (angular, linear) in radians and scene units, [..., 6].
      point: Points x in scene units, [..., 3].

    Returns:
      `apply_twist(twist, x) - x` [..., 3]; small motions keep all their digits.
    """
    return lie.displacement(twist[:3], twist[3:], point)


@checked(broadcast=True)
@at_least_float32
def multiply(second: Transform, first: Transform) -> Transform:
    """Compose two rigid transforms: the result applies `first`, then `second`.

    Args:
      second: Rigid transforms [..., 4, 4].
      first: Rigid transforms [..., 4, 4].

    Returns:
      The products `second @ first`, [..., 4, 4].
    """
    return exact_product(second, first)


@checked(broadcast=True)
@at_least_float32
def inverse(transform: Transform) -> Transform:
    """Invert a rigid transform by its transpose, without solving.

    Args:
      transform: Rigid transforms [..., 4, 4]; the last row is not read.

    Returns:
      The inverse transforms [..., 4, 4].
    """
    rotation = transform[:3, :3].T
    return from_rotation_translation(
        rotation, -exact_product(rotation, transform[:3, 3])
    )


@checked(broadcast=True)
def left_jacobian(twist: Twist) -> Float[Array, "6 6"]:
    """Compute the left Jacobian of the exponential map.

    Args:
      twist: (angular, linear) in radians and scene units, [..., 6].

    Returns:
      J [..., 6, 6] with exp(s + d) = exp(J d) exp(s) to first order in d.

    References:
      Barfoot and Furgale 2014, equation 102.
    """
    return lie.left_jacobian_se3(twist[:3], twist[3:])


@checked(broadcast=True)
@at_least_float32
def from_rotation_translation(
    rotation: Float[Array, "3 3"], translation: Vector
) -> Transform:
    """Assemble a rigid transform from its parts.

    Args:
      rotation: Rotation matrices [..., 3, 3].
      translation: Translations in scene units, [..., 3].

    Returns:
      Homogeneous matrices [..., 4, 4].
    """
    upper = jnp.concatenate([rotation, translation[:, None]], axis=1)
    last = jnp.zeros_like(upper[:1]).at[0, 3].set(1)
    return jnp.concatenate([upper, last])


def identity(dtype: jnp.dtype | type = jnp.float32) -> Transform:
    """Make the identity transform.

    Args:
      dtype: Floating-point type of the result.

    Returns:
      The 4x4 identity matrix.
    """
    return jnp.eye(4, dtype=dtype)
