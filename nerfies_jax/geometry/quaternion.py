"""Rotations as quaternions wxyz (scalar first, Hamilton product), one at a time.

q and -q are the same rotation. Functions that need unit length make it themselves,
since what an optimizer moves is never exactly of length one.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.contract import checked
from nerfies_jax.geometry.fusion import components, stacked
from nerfies_jax.geometry.jacobi import cross, dot
from nerfies_jax.geometry.precision import at_least_float32, near_one
from nerfies_jax.geometry.stumpff import stumpff

Quaternion = Float[Array, "4"]

# tan²(θ/2), that is θ < 0.4 rad: below, the series of arctan. Fourteen terms leave
# 3e-21.
SERIES_BELOW = 0.04
_ARCTAN = tuple((-1) ** n / (2 * n + 1) for n in range(14))


@checked(broadcast=True)
@at_least_float32
def normalize(quaternion: Quaternion) -> Quaternion:
    """The same rotation at unit length.

    Zero (in float32 also what XLA flushes to it, below 1.2e-38) and infinity give the
    identity with zero gradient: 0/0 would poison the whole batch, and q / (|q| + small)
    would return something that is no rotation. Slopes are as large as 1 / |q|, and a
    curvature overflows below a length of 1e-19 in float32.
    """
    largest = jnp.max(jnp.abs(quaternion))
    # NaN is neither small nor infinite and passes through.
    unusable = (largest < jnp.finfo(quaternion.dtype).tiny) | (largest == jnp.inf)
    # The whole quaternion is replaced, not its length: inf times the zero of the branch
    # not taken is NaN. Scaled first: |q|³ in its curvature underflows from 1e-13 down.
    usable = jnp.where(unusable, identity(quaternion.dtype), quaternion)
    parts = components(near_one(usable)[0])
    length = jnp.sqrt(sum(part * part for part in parts))
    return stacked([part / length for part in parts])


def identity(dtype=jnp.float32) -> Quaternion:
    return jnp.asarray([1, 0, 0, 0], dtype)


@checked(broadcast=True)
@at_least_float32
def multiply(second: Quaternion, first: Quaternion) -> Quaternion:
    """The rotation `first`, then `second`: the matrices' order of reading."""
    w, *v = components(second)
    a, *u = components(first)
    turn = cross(v, u)
    vector = [w * u[i] + a * v[i] + turn[i] for i in range(3)]
    return stacked([w * a - dot(v, u), *vector])


@checked(broadcast=True)
def conjugate(quaternion: Quaternion) -> Quaternion:
    """The inverse rotation of a unit quaternion."""
    return jnp.concatenate([quaternion[:1], -quaternion[1:]])


@checked(broadcast=True)
@at_least_float32
def rotate(quaternion: Quaternion, vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """One vector, turned; the quaternion may have any length."""
    unit = normalize(quaternion)
    swept = jnp.cross(unit[1:], vector)
    return vector + 2 * (unit[0] * swept + jnp.cross(unit[1:], swept))


@checked(broadcast=True)
@at_least_float32
def to_matrix(quaternion: Quaternion) -> Float[Array, "3 3"]:
    """The rotation matrix; the quaternion may have any length.

    The polynomial in an unnormalized q is no rotation: |q| = 1.01 bends it by 0.057.
    """
    w, x, y, z = normalize(quaternion)
    # One stack: nested ones are slow under `vmap` (see matrix3).
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return jnp.stack(entries).reshape(3, 3)


@checked(broadcast=True)
@at_least_float32
def from_matrix(rotation: Float[Array, "3 3"]) -> Quaternion:
    """The unit quaternion of a rotation matrix, with w not negative.

    Shepperd 1978: 4 q qᵀ is linear in the matrix, and its longest row is q up to
    length. A formula with a fixed pivot loses all digits where that component is 0.
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
    rows = jnp.stack(rows).reshape(4, 4)
    return _upper(normalize(rows[jnp.argmax(diagonal)]))


@checked(broadcast=True)
@at_least_float32
def exp(rotation_vector: Float[Array, "3"]) -> Quaternion:
    """The unit quaternion of axis × angle, in rad; below 1e19 rad in float32."""
    parts = components(rotation_vector)
    quarter_sq = dot(parts, parts) / 4
    half = stumpff(1, quarter_sq) / 2
    return stacked([stumpff(0, quarter_sq), *(half * part for part in parts)])


@checked(broadcast=True)
@at_least_float32
def log(quaternion: Quaternion) -> Float[Array, "3"]:
    """Axis × angle, the short way round (at most π rad), of a quaternion of any length.

    Zero for zero and infinity, as `normalize` takes them.
    """
    # The quotients below need no unit length, but their squares have half the range.
    upper = _upper(normalize(quaternion))
    scalar, vector = upper[0], upper[1:]
    sine_sq = jnp.sum(vector**2)
    near = sine_sq < SERIES_BELOW * scalar**2
    divisor = jnp.where(near, scalar, 1)
    tangent_sq = jnp.where(near, sine_sq, 0) / divisor**2
    series = jnp.zeros_like(sine_sq)
    for coefficient in reversed(_ARCTAN):
        series = series * tangent_sq + coefficient
    sine = jnp.sqrt(jnp.where(near, 1, sine_sq))
    far = jnp.arctan2(sine, scalar) / sine  # right up to π, where an arccos is not
    return 2 * jnp.where(near, series / divisor, far) * vector


@checked(broadcast=True)
@at_least_float32
def slerp(start: Quaternion, end: Quaternion, fraction: Float[Array, ""]) -> Quaternion:
    """Between two unit quaternions at constant speed, the short way round."""
    turn = log(multiply(end, conjugate(start)))
    return multiply(exp(fraction * turn), start)


def _upper(quaternion: Quaternion) -> Quaternion:
    """Of q and -q the one with w not negative: the turn of at most π."""
    return jnp.where(quaternion[0] < 0, -quaternion, quaternion)
