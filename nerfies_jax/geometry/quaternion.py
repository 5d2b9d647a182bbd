"""Rotations as quaternions wxyz (scalar first, Hamilton product).

Leading axes of all arguments broadcast. q and -q are the same rotation. Functions that
need unit length normalize their arguments, since an optimizer never keeps a length of
exactly one.
"""

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from nerfies_jax.geometry.fusion import components, stacked
from nerfies_jax.geometry.jacobi import cross, dot
from nerfies_jax.geometry.precision import at_least_float32, near_one
from nerfies_jax.geometry.stumpff import stumpff
from nerfies_jax.runtime.contract import checked

Quaternion = Float[Array, "4"]

# The series of arctan is used below this tan²(θ/2), which is at θ = 0.4 rad. Its error
# after 14 terms is 3e-21.
SERIES_BELOW = 0.04
_ARCTAN = tuple((-1) ** n / (2 * n + 1) for n in range(14))


@checked(broadcast=True)
@at_least_float32
def normalize(quaternion: Quaternion) -> Quaternion:
    """Scale quaternions to unit length.

    Zero (in float32 also values below 1.2e-38, which XLA flushes to zero) and infinity
    give the identity with zero gradient. Otherwise 0/0 would make the gradients of a
    whole batch NaN, and q / (|q| + eps) is no unit quaternion. Gradients are as large
    as 1 / |q|, and second derivatives overflow below a length of 1e-19 in float32.

    Args:
      quaternion: Quaternions of any length, [..., 4].

    Returns:
      Unit quaternions of the same rotations, [..., 4].
    """
    largest = jnp.max(jnp.abs(quaternion))
    # NaN is neither small nor infinite and passes through.
    unusable = (largest < jnp.finfo(quaternion.dtype).tiny) | (largest == jnp.inf)
    # The whole quaternion is replaced and not its length, because inf times the zero
    # gradient of the unused branch is NaN. It is scaled first, because |q|³ in the
    # second derivative underflows below 1e-13.
    usable = jnp.where(unusable, identity(quaternion.dtype), quaternion)
    parts = components(near_one(usable)[0])
    length = jnp.sqrt(sum(part * part for part in parts))
    return stacked([part / length for part in parts])


def identity(dtype: DTypeLike = jnp.float32) -> Quaternion:
    """Make the identity rotation.

    Args:
      dtype: Floating-point type of the result.

    Returns:
      The quaternion (1, 0, 0, 0).
    """
    return jnp.asarray([1, 0, 0, 0], dtype)


@checked(broadcast=True)
@at_least_float32
def multiply(second: Quaternion, first: Quaternion) -> Quaternion:
    """Compose two rotations: the result applies `first`, then `second`.

    Args:
      second: Quaternions, [..., 4].
      first: Quaternions, [..., 4].

    Returns:
      The Hamilton products `second` `first`, [..., 4].
    """
    w, *v = components(second)
    a, *u = components(first)
    turn = cross(v, u)
    vector = [w * u[i] + a * v[i] + turn[i] for i in range(3)]
    return stacked([w * a - dot(v, u), *vector])


@checked(broadcast=True)
def conjugate(quaternion: Quaternion) -> Quaternion:
    """Invert the rotation of unit quaternions.

    Args:
      quaternion: Unit quaternions, [..., 4].

    Returns:
      The conjugates, [..., 4].
    """
    return jnp.concatenate([quaternion[:1], -quaternion[1:]])


@checked(broadcast=True)
@at_least_float32
def rotate(quaternion: Quaternion, vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Rotate vectors.

    Args:
      quaternion: Quaternions of any length, [..., 4].
      vector: Vectors, [..., 3].

    Returns:
      The rotated vectors, [..., 3].
    """
    unit = normalize(quaternion)
    product = jnp.cross(unit[1:], vector)
    return vector + 2 * (unit[0] * product + jnp.cross(unit[1:], product))


@checked(broadcast=True)
@at_least_float32
def to_matrix(quaternion: Quaternion) -> Float[Array, "3 3"]:
    """Compute rotation matrices.

    The quaternion is normalized first. The polynomial of an unnormalized q is
    not a rotation: |q| = 1.01 distorts it by 0.057.

    Args:
      quaternion: Quaternions of any length, [..., 4].

    Returns:
      Rotation matrices, [..., 3, 3].
    """
    w, x, y, z = normalize(quaternion)
    # One stack, because nested stacks are slow under `vmap` (see matrix3).
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return jnp.stack(entries).reshape(3, 3)


@checked(broadcast=True)
@at_least_float32
def from_matrix(rotation: Float[Array, "3 3"]) -> Quaternion:
    """Compute the quaternions of rotation matrices.

    4 q qᵀ is linear in the matrix, and its longest row is q up to length. A formula
    with a fixed pivot loses all digits where that component is 0.

    Args:
      rotation: Rotation matrices, [..., 3, 3].

    Returns:
      Unit quaternions with w not negative, [..., 4].

    References:
      Shepperd 1978.
    """
    r = rotation
    w = [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    diagonal = jnp.stack(
        [
            1 + r[0, 0] + r[1, 1] + r[2, 2],
            1 + r[0, 0] - r[1, 1] - r[2, 2],
            1 - r[0, 0] + r[1, 1] - r[2, 2],
            1 - r[0, 0] - r[1, 1] + r[2, 2],
        ]
    )
    rows = [
        *(diagonal[0], *w),
        *(w[0], diagonal[1], xy, xz),
        *(w[1], xy, diagonal[2], yz),
        *(w[2], xz, yz, diagonal[3]),
    ]
    matrix = jnp.stack(rows).reshape(4, 4)
    return _with_positive_w(normalize(matrix[jnp.argmax(diagonal)]))


@checked(broadcast=True)
@at_least_float32
def exp(rotation_vector: Float[Array, "3"]) -> Quaternion:
    """Compute the quaternions of rotation vectors.

    Args:
      rotation_vector: Axis × angle in radians, [..., 3], below 1e19 rad in float32.

    Returns:
      Unit quaternions, [..., 4].
    """
    parts = components(rotation_vector)
    quarter_sq = dot(parts, parts) / 4
    half = stumpff(1, quarter_sq) / 2
    return stacked([stumpff(0, quarter_sq), *(half * part for part in parts)])


@checked(broadcast=True)
@at_least_float32
def log(quaternion: Quaternion) -> Float[Array, "3"]:
    """Compute the rotation vectors of quaternions.

    Args:
      quaternion: Quaternions of any length, [..., 4].

    Returns:
      Axis × angle [..., 3], with angles of at most π rad. Zero and infinite quaternions
      give zero, as in `normalize`.
    """
    # The quotients below do not need unit length, but squares of an unnormalized
    # quaternion could overflow or underflow.
    unit = _with_positive_w(normalize(quaternion))
    scalar, vector = unit[0], unit[1:]
    sine_sq = jnp.sum(vector**2)
    near = sine_sq < SERIES_BELOW * scalar**2
    divisor = jnp.where(near, scalar, 1)
    tangent_sq = jnp.where(near, sine_sq, 0) / divisor**2
    series = jnp.zeros_like(sine_sq)
    for coefficient in reversed(_ARCTAN):
        series = series * tangent_sq + coefficient
    sine = jnp.sqrt(jnp.where(near, 1, sine_sq))
    far = jnp.arctan2(sine, scalar) / sine  # accurate up to π, unlike arccos
    return 2 * jnp.where(near, series / divisor, far) * vector


@checked(broadcast=True)
@at_least_float32
def slerp(start: Quaternion, end: Quaternion, fraction: Float[Array, ""]) -> Quaternion:
    """Interpolate between unit quaternions at constant speed, along the shorter arc.

    Args:
      start: Unit quaternions at fraction 0, [..., 4].
      end: Unit quaternions at fraction 1, [..., 4].
      fraction: Position between the two, [...].

    Returns:
      Unit quaternions, [..., 4].
    """
    turn = log(multiply(end, conjugate(start)))
    return multiply(exp(fraction * turn), start)


def _with_positive_w(quaternion: Quaternion) -> Quaternion:
    """Return q or -q, whichever has w >= 0 and so an angle of at most π."""
    return jnp.where(quaternion[0] < 0, -quaternion, quaternion)
