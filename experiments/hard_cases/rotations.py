"""Hard cases of screws: the exponential, its slopes, its Jacobians."""

import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from nerfies_jax.geometry import lie
from nerfies_jax.geometry.stumpff import SERIES_BELOW

AXIS = np.array([2.0, -1.0, 2.0]) / 3
LINEAR = np.array([0.4, -0.2, 0.3])
POINT = np.array([0.5, 0.25, -0.75])


def _screw(w):
    return lie.transform_point(w, constant(LINEAR, w.dtype), constant(POINT, w.dtype))


def _rodrigues(w):
    """Rodrigues' formula as in textbooks and in the official Nerfies code."""
    linear, point = constant(LINEAR, w.dtype), constant(POINT, w.dtype)
    angle = jnp.sqrt(jnp.sum(w**2))
    sine = jnp.sin(angle) / angle
    versine = (1 - jnp.cos(angle)) / angle**2
    quotient = (angle - jnp.sin(angle)) / angle**3
    rotated_point = point + sine * jnp.cross(w, point)
    rotated_point = rotated_point + versine * jnp.cross(w, jnp.cross(w, point))
    result = linear + versine * jnp.cross(w, linear)
    return rotated_point + result + quotient * jnp.cross(w, jnp.cross(w, linear))


def _exact_screw(w):
    w = mpmath.matrix(w)
    v, x = (mpmath.matrix([mpmath.mpf(float(c)) for c in y]) for y in (LINEAR, POINT))
    hat = mpmath.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    angle = mpmath.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    if angle == 0:
        return list(x + v)
    one = (1 - mpmath.cos(angle)) / angle**2
    two = (angle - mpmath.sin(angle)) / angle**3
    rotated_point = x + mpmath.sin(angle) / angle * (hat * x) + one * (hat * (hat * x))
    return list(rotated_point + v + one * (hat * v) + two * (hat * (hat * v)))


_EDGE = SERIES_BELOW**0.5
_NEAR = [0, 1e-30, 1e-8, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1]
_SEAM = [_EDGE * (1 - 1e-6), _EDGE * (1 + 1e-6)]
_ANGLES = np.array([*_NEAR, *_SEAM, 3.1, np.pi, 4, 2 * np.pi, 10])

SCREW = Case(
    name="screw near zero",
    breaks="Rodrigues' quotients are 0/0 at zero, and their derivatives cancel below "
    "1e-2 rad.",
    formula="Stumpff functions of |w|² are used, without division by the angle",
    switch=f"series below |w|² = {SERIES_BELOW:g}",
    axis="θ / rad",
    at=_ANGLES,
    along=AXIS,
    stable=_screw,
    textbook=_rodrigues,
    exact=_exact_screw,
    bounds={"float32": (1e-6, 2e-6, 4e-6), "float64": (2e-15, 5e-15, 1e-14)},
    timed=0.3 * AXIS,
)


def _exact_stumpff(order, angle_sq):
    """Sum the series of c_k to any number of digits, for up to about ten rad."""
    total, n = mpmath.mpf(0), 0
    term = 1 / mpmath.factorial(order)
    while abs(term) > mpmath.eps**2 or n < 4:
        total += term
        n += 1
        term *= -angle_sq / ((2 * n + order - 1) * (2 * n + order))
    return total


def _hat(w):
    return mpmath.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def _square(w):
    return w[0] ** 2 + w[1] ** 2 + w[2] ** 2


def _column(values):
    return mpmath.matrix([mpmath.mpf(float(value)) for value in values])


def _exact_displacement(w, v, x):
    w, v = mpmath.matrix(w), mpmath.matrix(v)
    hat, angle_sq = _hat(w), _square(w)
    one, two, three = (_exact_stumpff(k, angle_sq) for k in (1, 2, 3))
    shift = one * (hat * x) + two * (hat * (hat * x))
    return list(shift + v + two * (hat * v) + three * (hat * (hat * v)))


def _textbook_displacement(w, v, x):
    """The moved point less the point."""
    angle = jnp.sqrt(jnp.sum(w**2))
    hat, eye = lie.hat(w / angle), jnp.eye(3, dtype=w.dtype)
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    rotation = eye + sine * hat + (1 - cosine) * hat @ hat
    left = eye + (1 - cosine) / angle * hat + (angle - sine) / angle * hat @ hat
    return rotation @ x + left @ v - x


def _of_screw(form):
    """Evaluate at w and v = speed times a fixed direction."""
    return lambda screw: form(
        screw[:3],
        screw[3] * constant(LINEAR, screw.dtype),
        constant(POINT, screw.dtype),
    )


_displacement = _of_screw(lie.displacement)
_displaced_textbook = _of_screw(_textbook_displacement)


def _exact_displaced(screw):
    return _exact_displacement(screw[:3], screw[3] * _column(LINEAR), _column(POINT))


def _screws(turns, speeds):
    """[screws, 4] rotation vectors of those angles, and speeds."""
    turns, speeds = np.broadcast_arrays(turns, speeds)
    return np.concatenate([turns[:, None] * AXIS, speeds[:, None]], axis=1)


_TURNS = np.array([1e-30, 1e-12, 1e-8, 1e-5, 1e-3, 1e-2, 0.3, *_SEAM, 4])
TURN = Case(
    name="displacement by a small rotation",
    breaks="R x - x cancels, and so does 1 - cos θ.",
    formula="w x (...) is computed with Stumpff functions, and the point is never "
    "added",
    switch=f"series below |w|² = {SERIES_BELOW:g}",
    axis="θ / rad",
    at=_TURNS,
    points=_screws(_TURNS, 0.0),
    stable=_displacement,
    textbook=_displaced_textbook,
    exact=_exact_displaced,
    bounds={"float32": (1e-6, 1e-6, 1e-6), "float64": (2e-15, 2e-15, 3e-15)},
    timed=np.array([*(0.3 * AXIS), 0.0]),
)

_SPEEDS = np.array([0, 1e-20, 1e-8, 1e-4, 1e-2, 1, 1e3, 1e6])
SHIFT = Case(
    name="translation with a rotation of 1e-4 rad",
    breaks="Gradients with respect to the rotation come from (1 - cos θ)/θ², which "
    "cancels, and grow with |v|.",
    formula="Stumpff functions of |w|² are used, and v enters linearly",
    axis="speed / scene units",
    at=_SPEEDS,
    points=_screws(1e-4, _SPEEDS),
    stable=_displacement,
    textbook=_displaced_textbook,
    exact=_exact_displaced,
    bounds={"float32": (1e-6, 1e-6, 1e-6), "float64": (2e-15, 2e-15, 2e-15)},
    timed=np.array([*(0.3 * AXIS), 1.0]),
)


def _inverse_jacobian(w):
    return lie.inverse_left_jacobian(w) @ constant(LINEAR, w.dtype)


def _textbook_inverse_jacobian(w):
    angle, v = jnp.sqrt(jnp.sum(w**2)), constant(LINEAR, w.dtype)
    twice = jnp.cross(w, jnp.cross(w, v))
    quotient = (1 - angle / 2 / jnp.tan(angle / 2)) / angle**2
    return v - jnp.cross(w, v) / 2 + quotient * twice


def _exact_inverse_jacobian(w):
    w, v = mpmath.matrix(w), _column(LINEAR)
    hat, angle_sq = _hat(w), _square(w)
    two, three, four = (_exact_stumpff(k, angle_sq) for k in (2, 3, 4))
    quotient = (three - 2 * four) / (2 * two)
    return list(v - hat * v / 2 + quotient * (hat * (hat * v)))


_TO_TURN = np.array([0, 1e-20, 1e-8, 1e-4, 1e-3, 1e-2, 0.3, *_SEAM, 4, 5, 6])
INVERSE_JACOBIAN = Case(
    name="inverse left Jacobian",
    breaks="1 - θ/2 cot θ/2 cancels and is divided by θ².",
    formula="(c3 - 2 c4) / (2 c2) is computed from Stumpff functions",
    switch=f"series below |w|² = {SERIES_BELOW:g}",
    axis="θ / rad",
    at=_TO_TURN,
    along=AXIS,
    stable=_inverse_jacobian,
    textbook=_textbook_inverse_jacobian,
    exact=_exact_inverse_jacobian,
    bounds={"float32": (1e-6, 2e-6, 3e-6), "float64": (6e-15, 1e-14, 3e-14)},
    timed=0.3 * AXIS,
)


def _coupling(w):
    """The lower left block of the screws' Jacobian, on one vector."""
    jacobian = lie.left_jacobian_se3(w, constant(LINEAR, w.dtype))
    return jacobian[3:, :3] @ constant(POINT, w.dtype)


def _coupling_terms(w, v):
    wv, vw = w * v, v * w
    wvw = wv * w
    yield v / 2
    yield wv + vw + wvw
    yield w * wv + vw * w - 3 * wvw
    yield wvw * w + w * wvw


def _textbook_coupling(w):
    """Barfoot and Furgale 2014, equation 102, as printed."""
    angle = jnp.sqrt(jnp.sum(w**2))
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    hat, shift = lie.hat(w), lie.hat(constant(LINEAR, w.dtype))
    wv, vw = hat @ shift, shift @ hat
    wvw = wv @ hat
    three = (angle - sine) / angle**3
    four = (1 - angle**2 / 2 - cosine) / angle**4
    five = (angle - sine - angle**3 / 6) / angle**5
    matrix = (
        shift / 2
        + three * (wv + vw + wvw)
        - four * (hat @ wv + vw @ hat - 3 * wvw)
        - (four - 3 * five) / 2 * (wvw @ hat + hat @ wvw)
    )
    return matrix @ constant(POINT, w.dtype)


def _exact_coupling(w):
    w = mpmath.matrix(w)
    angle_sq = _square(w)
    three, four, five = (_exact_stumpff(k, angle_sq) for k in (3, 4, 5))
    factors = 1, three, four, (four - 3 * five) / 2
    terms = _coupling_terms(_hat(w), _hat(_column(LINEAR)))
    total = mpmath.zeros(3)
    for factor, term in zip(factors, terms, strict=True):
        total += factor * term
    return list(total * _column(POINT))


_TO_HALF = np.array([0, 1e-12, 1e-6, 1e-3, 1e-2, 0.1, 0.5, 1, *_SEAM, np.pi, 6])
COUPLING = Case(
    name="translation block of the SE(3) left Jacobian",
    breaks="Barfoot's quotients by θ⁴ and θ⁵ cancel from 0.5 rad down.",
    formula="The Stumpff functions c3, c4 and c5 are used",
    switch=f"series below |w|² = {SERIES_BELOW:g}",
    axis="θ / rad",
    at=_TO_HALF,
    along=AXIS,
    stable=_coupling,
    textbook=_textbook_coupling,
    exact=_exact_coupling,
    bounds={"float32": (2e-6, 2e-6, 3e-6), "float64": (5e-15, 5e-15, 4e-15)},
    timed=0.3 * AXIS,
)

CASES = (SCREW, TURN, SHIFT, INVERSE_JACOBIAN, COUPLING)
