"""Exponentials, logarithms and Jacobians of rotations and twists, for one point.

A twist is `angular` (axis × angle, rad) and `linear` (scene units), the (w, v) of
Nerfies (Park et al. 2021, arXiv:2011.12948, equations 9 and 11). `linear` is not the
translation, which is `left_jacobian(angular) @ linear`. Coefficients are Stumpff
functions of |w|², which are smooth at 0, where zero-initialized networks start.

The error of a rotation is that of its angle: 6e-8 |w| rad in float32, which is 6e-4 at
1e4 rad. Angles above 1e19 rad overflow float32.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.geometry import quaternion
from nerfies_jax.geometry.jacobi import cross
from nerfies_jax.geometry.precision import at_least_float32, exact_product
from nerfies_jax.geometry.stumpff import stumpff
from nerfies_jax.runtime.contract import checked

Vector = Float[Array, "3"]
Matrix = Float[Array, "3 3"]


@checked(broadcast=True)
@at_least_float32
def transform_point(angular: Vector, linear: Vector, point: Vector) -> Vector:
    """Move one point by the exponential of a twist, without forming a matrix.

    All terms are cross products w × (...). Computing (1 + G W) x would lose θ ulps.

    Args:
      angular: Rotation vector w in radians, [3].
      linear: Linear part v in scene units, [3].
      point: Point x in scene units, [3].

    Returns:
      R x + G v, [3].
    """
    return point + displacement(angular, linear, point)


@checked(broadcast=True)
@at_least_float32
def displacement(angular: Vector, linear: Vector, point: Vector) -> Vector:
    """Compute how far `transform_point` moves a point, without cancellation.

    Its Jacobian keeps strains that adding the identity would round away. See
    `matrix3.displacement_log_energy`.

    Args:
      angular: Rotation vector w in radians, [3].
      linear: Linear part v in scene units, [3].
      point: Point x in scene units, [3].

    Returns:
      (R - 1) x + G v, [3].
    """
    angle_sq = jnp.sum(angular**2)
    c1, c2, c3 = (stumpff(k, angle_sq) for k in (1, 2, 3))
    inner = c1 * point + c2 * linear + _cross(angular, c2 * point + c3 * linear)
    return linear + _cross(angular, inner)


@checked(broadcast=True)
@at_least_float32
def rotate_point(angular: Vector, point: Vector) -> Vector:
    """Rotate one point about the origin.

    Args:
      angular: Rotation vector in radians, [3].
      point: Point, [3].

    Returns:
      The rotated point, [3].
    """
    angle_sq = jnp.sum(angular**2)
    inner = stumpff(1, angle_sq) * point
    return point + _cross(
        angular, inner + _cross(angular, stumpff(2, angle_sq) * point)
    )


@checked(broadcast=True)
@at_least_float32
def exp_so3(angular: Vector) -> Matrix:
    """Compute the rotation matrix of a rotation vector (Rodrigues' formula).

    Args:
      angular: Rotation vector in radians, [3].

    Returns:
      The rotation matrix, [3, 3].
    """
    basis = jnp.eye(3, dtype=angular.dtype)
    return jax.vmap(rotate_point, (None, 0), out_axes=1)(angular, basis)


@checked(broadcast=True)
@at_least_float32
def log_so3(rotation: Matrix) -> Vector:
    """Compute the rotation vector of a rotation matrix.

    It is computed from the quaternion. The arccosine of the trace is NaN for rotations
    below 1e-4 rad in float32 and off by 0.1 rad at π - 1e-3.

    Args:
      rotation: Rotation matrix, [3, 3].

    Returns:
      Axis × angle [3], with an angle of at most π rad.
    """
    return quaternion.log(quaternion.from_matrix(rotation))


@checked(broadcast=True)
@at_least_float32
def exp_se3(angular: Vector, linear: Vector) -> tuple[Matrix, Vector]:
    """Compute the rigid transform of a twist.

    Args:
      angular: Rotation vector in radians, [3].
      linear: Linear part in scene units, [3].

    Returns:
      Rotation matrix [3, 3] and translation in scene units [3].
    """
    return exp_so3(angular), exact_product(left_jacobian(angular), linear)


@checked(broadcast=True)
@at_least_float32
def log_se3(rotation: Matrix, translation: Vector) -> tuple[Vector, Vector]:
    """Compute the twist of a rigid transform. Inverts `exp_se3` for angles below π.

    Args:
      rotation: Rotation matrix, [3, 3].
      translation: Translation in scene units, [3].

    Returns:
      The angular part [3] in radians and the linear part [3] in scene units.
    """
    angular = log_so3(rotation)
    return angular, exact_product(inverse_left_jacobian(angular), translation)


@checked(broadcast=True)
@at_least_float32
def left_jacobian(angular: Vector) -> Matrix:
    """Compute the left Jacobian of `exp_so3`, ∫₀¹ exp(τ [w]) dτ.

    Args:
      angular: Rotation vector w in radians, [3].

    Returns:
      J [3, 3] with exp(w + d) = exp(J d) exp(w) to first order in d.
    """
    angle_sq = jnp.sum(angular**2)
    return _polynomial(angular, stumpff(2, angle_sq), stumpff(3, angle_sq))


@checked(broadcast=True)
@at_least_float32
def inverse_left_jacobian(angular: Vector) -> Matrix:
    """Compute the inverse of `left_jacobian`.

    Args:
      angular: Rotation vector in radians, [3], below 2π, where the Jacobian is
        singular.

    Returns:
      The inverse matrix, [3, 3].
    """
    angle_sq = jnp.sum(angular**2)
    # The coefficient (1 - θ/2 cot(θ/2)) / θ² cancels. This quotient of sums does not.
    c2, c3, c4 = (stumpff(k, angle_sq) for k in (2, 3, 4))
    return _polynomial(angular, -jnp.full_like(c2, 0.5), (c3 - 2 * c4) / (2 * c2))


@checked(broadcast=True)
@at_least_float32
def left_jacobian_se3(angular: Vector, linear: Vector) -> Float[Array, "6 6"]:
    """Compute the left Jacobian of `exp_se3`, ordered (angular, linear).

    Args:
      angular: Rotation vector in radians, [3].
      linear: Linear part in scene units, [3].

    Returns:
      The block matrix [[J, 0], [Q, J]], [6, 6].

    References:
      Barfoot and Furgale 2014, "Associating uncertainty with three-dimensional poses
      for use in estimation problems", equation 102, with their coefficients written as
      Stumpff functions.
    """
    jacobian, coupling = left_jacobian(angular), _coupling(angular, linear)
    return jnp.block([[jacobian, jnp.zeros_like(jacobian)], [coupling, jacobian]])


@checked(broadcast=True)
def hat(vector: Vector) -> Matrix:
    """Compute the skew-symmetric matrix of a vector.

    Args:
      vector: Vector w, [3].

    Returns:
      The matrix [w] with [w] x = w × x, [3, 3].
    """
    x, y, z = vector
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def _cross(a, b):
    # `jnp.cross` moves axes and concatenates, which does not fuse.
    return jnp.stack(cross(a, b))


def _polynomial(angular, first, second):
    """Compute 1 + first [w] + second [w]²."""
    turn = hat(angular)
    square = jnp.outer(angular, angular) - jnp.sum(angular**2) * jnp.eye(
        3, dtype=angular.dtype
    )
    return jnp.eye(3, dtype=angular.dtype) + first * turn + second * square


def _coupling(angular, linear):
    """Compute the block Q of `left_jacobian_se3`."""
    angle_sq = jnp.sum(angular**2)
    c3, c4, c5 = (stumpff(k, angle_sq) for k in (3, 4, 5))
    w, v = hat(angular), hat(linear)
    wv, vw = exact_product(w, v), exact_product(v, w)
    wvw = exact_product(wv, w)
    third = exact_product(w, wv) + exact_product(vw, w) - 3 * wvw
    fourth = exact_product(wvw, w) + exact_product(w, wvw)
    return v / 2 + c3 * (wv + vw + wvw) + c4 * third + (c4 - 3 * c5) / 2 * fourth
