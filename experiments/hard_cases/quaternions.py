"""Hard cases of quaternions, and of the logarithm of rotations."""

import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from nerfies_jax.geometry import lie, quaternion

AXIS = np.array([2.0, -1.0, 2.0]) / 3
_EDGE = 2 * np.arctan(quaternion.SERIES_BELOW**0.5)
_SEAM = [_EDGE * (1 - 1e-6), _EDGE * (1 + 1e-6)]


def _half_turns(angles):
    """Return [angles, 4] unit quaternions, with a negative scalar part past π."""
    halves = np.asarray(angles)[:, None] / 2
    return np.concatenate([np.cos(halves), np.sin(halves) * AXIS], axis=1)


def _textbook_log(q):
    """Compute the logarithm from the arc cosine of the scalar."""
    q = q / jnp.sqrt(jnp.sum(q**2))
    q = jnp.where(q[0] < 0, -q, q)
    half = jnp.arccos(q[0])
    return 2 * half / jnp.sin(half) * q[1:]


def _exact_log(q):
    sign = -1 if q[0] < 0 else 1
    w, x, y, z = (sign * c for c in q)
    sine = mpmath.sqrt(x**2 + y**2 + z**2)
    if sine == 0:
        return [mpmath.mpf(0)] * 3
    half = mpmath.atan2(sine, w)
    return [2 * half / sine * c for c in (x, y, z)]


_NEAR = [0, 1e-20, 1e-8, 1e-5, 1e-3, 0.1, *_SEAM, 1, 3]
_FLAT = [np.pi - 1e-3, np.pi - 1e-6, np.pi + 1e-6, np.pi + 1e-3]
_BOTH = np.array([*_NEAR, *_FLAT, 4, 2 * np.pi - 1e-3])
LOGARITHM = Case(
    name="logarithm of a quaternion",
    breaks="arccos w has no digits left at w = 1, where sin θ/2 is 0.",
    formula="arctan2(|v|, w) / |v| is used for w >= 0, and a series in |v|²/w² for "
    "small angles",
    switch=f"switch at tan²(θ/2) = {quaternion.SERIES_BELOW:g}, and at π, where w "
    "changes sign",
    axis="θ / rad",
    at=_BOTH,
    points=_half_turns(_BOTH),
    stable=quaternion.log,
    textbook=_textbook_log,
    exact=_exact_log,
    bounds={"float32": (1e-6, 1e-6, 3e-6), "float64": (2e-15, 2e-15, 3e-15)},
    timed=_half_turns([1.0])[0],
)


def _rotation(w):
    return quaternion.to_matrix(quaternion.exp(w))


def _textbook_matrix_log(w):
    """Compute the logarithm from the arc cosine of the trace."""
    rotation = _rotation(w)
    angle = jnp.arccos((jnp.trace(rotation) - 1) / 2)
    skew = rotation - rotation.T
    axis = jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    return angle / (2 * jnp.sin(angle)) * axis


def _exact_wrapped(w):
    angle = mpmath.sqrt(sum(c**2 for c in w))
    around = 2 * mpmath.pi / angle if angle > mpmath.pi else 0
    return [c * (1 - around) for c in w]


# Closer to π the rounded matrix itself may lie on the other side.
_TO_FLAT = [1e-20, 1e-8, 1e-4, 1e-2, *_SEAM, 1.5, 3]
_ROUND = np.array([*_TO_FLAT, np.pi - 1e-5, np.pi + 1e-5, 4])
MATRIX_LOGARITHM = Case(
    name="logarithm of a rotation matrix",
    breaks="arccos of the trace has no digits at 0 and π, and at π, where R = Rᵀ, "
    "the axis is lost.",
    formula="The quaternion is computed with the largest pivot, and then its logarithm",
    switch="switch where another pivot is the largest",
    axis="θ / rad",
    at=_ROUND,
    along=AXIS,
    stable=lambda w: lie.log_so3(_rotation(w)),
    textbook=_textbook_matrix_log,
    exact=_exact_wrapped,
    bounds={"float32": (1e-6, 1e-6, 2e-6), "float64": (2e-15, 2e-15, 2e-15)},
    floors=(0, 0, 1),
    timed=AXIS,
)


def _textbook_matrix(q):
    """The polynomial in q / |q|."""
    w, x, y, z = q / jnp.sqrt(jnp.sum(q**2))
    return jnp.stack(_entries(w, x, y, z))


def _entries(w, x, y, z):
    return [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]


def _exact_matrix(q):
    length_sq = sum(c**2 for c in q)
    if length_sq < mpmath.mpf(10) ** -60:  # zero, and the steps about it
        q, length_sq = [mpmath.mpf(c) for c in (1, 0, 0, 0)], mpmath.mpf(1)
    length = mpmath.sqrt(length_sq)
    return _entries(*(c / length for c in q))


_LENGTHS = np.array([0, 1e-18, 1e-15, 1e-10, 1e-3, 1, 1e3, 1e10, 1e15, 1e30, 2e38])
LENGTH = Case(
    name="rotation matrix of q of any length",
    breaks="Normalization is 0/0 at 0, and |q|³ in the curvature underflows from "
    "1e-13 down.",
    formula="q is scaled by a power of two without derivative and normalized, and "
    "zero and infinity give the identity",
    switch="switch at a largest component of 1.2e-38",
    axis="|q|",
    at=_LENGTHS,
    along=_half_turns([2.0]),
    stable=lambda q: quaternion.to_matrix(q).reshape(9),
    textbook=_textbook_matrix,
    exact=_exact_matrix,
    bounds={"float32": (1e-6, 1e-6, 1e-6), "float64": (2e-15, 2e-15, 2e-15)},
    floors=(0, 1e-31, 1e-37),  # 1 / 2e38 and 1 / 1e60 are zero in float32
    timed=_half_turns([2.0])[0],
)

SHARE = 0.25  # of the way, exact in binary
_START = np.array([0.5, -0.5, 0.5, 0.5])


def _slerp(w):
    """From the start, a quarter of the turn by w."""
    start = constant(_START, w.dtype)
    end = quaternion.multiply(quaternion.exp(w), start)
    return quaternion.slerp(start, end, constant(SHARE, w.dtype))


def _textbook_slerp(w):
    """Shoemake 1985, by sines of parts of the angle."""
    start = constant(_START, w.dtype)
    end = quaternion.multiply(quaternion.exp(w), start)
    end = jnp.where(jnp.sum(start * end) < 0, -end, end)
    angle = jnp.arccos(jnp.sum(start * end))
    first, second = jnp.sin((1 - SHARE) * angle), jnp.sin(SHARE * angle)
    return (first * start + second * end) / jnp.sin(angle)


def _exact_slerp(w):
    w = _exact_wrapped(w) if any(w) else w
    angle = mpmath.sqrt(sum(c**2 for c in w))
    sine = mpmath.sinc(SHARE * angle / 2) * SHARE / 2
    a, (b, c, d) = mpmath.cos(SHARE * angle / 2), (sine * x for x in w)
    e, f, g, h = (mpmath.mpf(x) for x in _START)
    return [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]


_APART = np.array([0, 1e-20, 1e-8, 1e-4, 1e-3, 0.1, *_SEAM, 1, 3, np.pi + 1e-3, 5])
SLERP = Case(
    name="slerp between close quaternions",
    breaks="Sines of fractions of the angle are divided by its sine, and arccos has "
    "lost the angle.",
    formula="The exponential of a fraction of the logarithm is used",
    switch=f"switch at tan²(θ/2) = {quaternion.SERIES_BELOW:g}, and at π to the "
    "shorter arc",
    axis="θ between / rad",
    at=_APART,
    along=AXIS,
    stable=_slerp,
    textbook=_textbook_slerp,
    exact=_exact_slerp,
    bounds={"float32": (1e-6, 1e-6, 4e-5), "float64": (2e-15, 2e-15, 3e-14)},
    timed=AXIS,
)

CASES = (LOGARITHM, MATRIX_LOGARITHM, LENGTH, SLERP)
