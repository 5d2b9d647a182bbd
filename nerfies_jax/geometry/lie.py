"""Rotations and screws of one point: exponentials, logarithms, Jacobians.

A screw is `angular` (axis × angle, rad) and `linear` (scene units): the twist (w, v) of
Nerfies (Park et al. 2021, arXiv:2011.12948, equations 9 and 11). `linear` is not the
translation; that is `left_jacobian(angular) @ linear`. Coefficients are Stumpff
functions of |w|², smooth at 0, so a zero-initialized head is no special case.
A turn is as exact as |w|: to 6e-8 |w| rad in float32, which is 6e-4 at 1e4 rad. Angles
above 1e19 rad overflow float32.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.contract import checked
from nerfies_jax.geometry import quaternion
from nerfies_jax.geometry.jacobi import cross
from nerfies_jax.geometry.precision import at_least_float32, exact_product
from nerfies_jax.geometry.stumpff import stumpff

Vector = Float[Array, "3"]
Matrix = Float[Array, "3 3"]


@checked(broadcast=True)
@at_least_float32
def transform_point(angular: Vector, linear: Vector, point: Vector) -> Vector:
    """One point moved along a screw: R x + G v, without any matrix.

    Written w × (...) throughout. Formed as (1 + G W) x it would lose θ ulps.
    """
    return point + displacement(angular, linear, point)


@checked(broadcast=True)
@at_least_float32
def displacement(angular: Vector, linear: Vector, point: Vector) -> Vector:
    """How far `transform_point` moves the point: (R - 1) x + G v, uncancelled.

    Its Jacobian keeps strains that adding the identity would round away; see
    `matrix3.displacement_log_energy`.
    """
    angle_sq = jnp.sum(angular**2)
    c1, c2, c3 = (stumpff(k, angle_sq) for k in (1, 2, 3))
    inner = c1 * point + c2 * linear + _cross(angular, c2 * point + c3 * linear)
    return linear + _cross(angular, inner)


@checked(broadcast=True)
@at_least_float32
def rotate_point(angular: Vector, point: Vector) -> Vector:
    """One point turned about the origin."""
    angle_sq = jnp.sum(angular**2)
    inner = stumpff(1, angle_sq) * point
    return point + _cross(
        angular, inner + _cross(angular, stumpff(2, angle_sq) * point)
    )


@checked(broadcast=True)
@at_least_float32
def exp_so3(angular: Vector) -> Matrix:
    """The rotation matrix of axis × angle (Rodrigues)."""
    basis = jnp.eye(3, dtype=angular.dtype)
    return jax.vmap(rotate_point, (None, 0), out_axes=1)(angular, basis)


@checked(broadcast=True)
@at_least_float32
def log_so3(rotation: Matrix) -> Vector:
    """Axis × angle of a rotation matrix, at most π rad.

    Through the quaternion with the largest pivot: arccos of the trace is NaN for turns
    below 1e-4 rad in float32 and 0.1 rad off at π - 1e-3.
    """
    return quaternion.log(quaternion.from_matrix(rotation))


@checked(broadcast=True)
@at_least_float32
def exp_se3(angular: Vector, linear: Vector) -> tuple[Matrix, Vector]:
    """Rotation matrix and translation of a screw."""
    return exp_so3(angular), exact_product(left_jacobian(angular), linear)


@checked(broadcast=True)
@at_least_float32
def log_se3(rotation: Matrix, translation: Vector) -> tuple[Vector, Vector]:
    """The screw of a rigid motion: the inverse of `exp_se3` for turns below π."""
    angular = log_so3(rotation)
    return angular, exact_product(inverse_left_jacobian(angular), translation)


@checked(broadcast=True)
@at_least_float32
def left_jacobian(angular: Vector) -> Matrix:
    """∫₀¹ exp(τ [w]) dτ: how `exp_so3(w)` turns as w moves, in the fixed frame."""
    angle_sq = jnp.sum(angular**2)
    return _polynomial(angular, stumpff(2, angle_sq), stumpff(3, angle_sq))


@checked(broadcast=True)
@at_least_float32
def inverse_left_jacobian(angular: Vector) -> Matrix:
    """The inverse, for turns below 2π, where it is singular."""
    angle_sq = jnp.sum(angular**2)
    # (1 - θ/2 cot(θ/2)) / θ², which cancels; as a quotient of sums it does not.
    c2, c3, c4 = (stumpff(k, angle_sq) for k in (2, 3, 4))
    return _polynomial(angular, -jnp.full_like(c2, 0.5), (c3 - 2 * c4) / (2 * c2))


@checked(broadcast=True)
@at_least_float32
def left_jacobian_se3(angular: Vector, linear: Vector) -> Float[Array, "6 6"]:
    """The same for screws, ordered (angular, linear): [[J, 0], [Q, J]].

    Barfoot and Furgale 2014, "Associating uncertainty with three-dimensional poses for
    use in estimation problems", equation 102; their coefficients in Stumpff functions.
    """
    jacobian, coupling = left_jacobian(angular), _coupling(angular, linear)
    return jnp.block([[jacobian, jnp.zeros_like(jacobian)], [coupling, jacobian]])


@checked(broadcast=True)
def hat(vector: Vector) -> Matrix:
    """[w], with [w] x = w × x."""
    x, y, z = vector
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def _cross(a, b):
    # jnp.cross moves axes and concatenates; this fuses.
    return jnp.stack(cross(a, b))


def _polynomial(angular, first, second):
    """1 + first [w] + second [w]²."""
    turn = hat(angular)
    square = jnp.outer(angular, angular) - jnp.sum(angular**2) * jnp.eye(
        3, dtype=angular.dtype
    )
    return jnp.eye(3, dtype=angular.dtype) + first * turn + second * square


def _coupling(angular, linear):
    angle_sq = jnp.sum(angular**2)
    c3, c4, c5 = (stumpff(k, angle_sq) for k in (3, 4, 5))
    w, v = hat(angular), hat(linear)
    wv, vw = exact_product(w, v), exact_product(v, w)
    wvw = exact_product(wv, w)
    third = exact_product(w, wv) + exact_product(vw, w) - 3 * wvw
    fourth = exact_product(wvw, w) + exact_product(w, wvw)
    return v / 2 + c3 * (wv + vw + wvw) + c4 * third + (c4 - 3 * c5) / 2 * fourth
