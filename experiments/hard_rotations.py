"""Hard cases of rotations and screws."""

import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_case import Case
from nerfies_jax.geometry import lie
from nerfies_jax.geometry.stumpff import SERIES_BELOW

AXIS = np.array([2.0, -1.0, 2.0]) / 3
LINEAR = np.array([0.4, -0.2, 0.3])
POINT = np.array([0.5, 0.25, -0.75])


def _screw(w):
    return lie.transform_point(
        w, jnp.asarray(LINEAR, w.dtype), jnp.asarray(POINT, w.dtype)
    )


def _rodrigues(w):
    """As it stands in the textbooks and in the official Nerfies code."""
    linear, point = jnp.asarray(LINEAR, w.dtype), jnp.asarray(POINT, w.dtype)
    angle = jnp.sqrt(jnp.sum(w**2))
    sine = jnp.sin(angle) / angle
    versine = (1 - jnp.cos(angle)) / angle**2
    rest = (angle - jnp.sin(angle)) / angle**3
    turned = point + sine * jnp.cross(w, point)
    turned = turned + versine * jnp.cross(w, jnp.cross(w, point))
    moved = linear + versine * jnp.cross(w, linear)
    return turned + moved + rest * jnp.cross(w, jnp.cross(w, linear))


def _exact_screw(w):
    w = mpmath.matrix(w)
    v, x = (mpmath.matrix([mpmath.mpf(float(c)) for c in y]) for y in (LINEAR, POINT))
    hat = mpmath.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    angle = mpmath.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    if angle == 0:
        return list(x + v)
    one = (1 - mpmath.cos(angle)) / angle**2
    two = (angle - mpmath.sin(angle)) / angle**3
    turned = x + mpmath.sin(angle) / angle * (hat * x) + one * (hat * (hat * x))
    return list(turned + v + one * (hat * v) + two * (hat * (hat * v)))


_EDGE = SERIES_BELOW**0.5
_NEAR = [0, 1e-30, 1e-8, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1]
_SEAM = [_EDGE * (1 - 1e-6), _EDGE * (1 + 1e-6)]
_ANGLES = np.array([*_NEAR, *_SEAM, 3.1, np.pi, 4, 2 * np.pi, 10])

SCREW = Case(
    name="screw near zero",
    breaks="Rodrigues' quotients: 0/0 at zero, their derivatives cancel below 1e-2",
    formula="Stumpff functions of |w|², no division by the angle",
    switch=f"|w|² = {SERIES_BELOW:g}",
    axis="θ / rad",
    at=_ANGLES,
    inputs=_ANGLES[:, None] * AXIS,
    stable=_screw,
    textbook=_rodrigues,
    exact=_exact_screw,
    bounds={"float32": (1e-6, 2e-6, 4e-6), "float64": (2e-15, 5e-15, 1e-14)},
    caught=(("float32", "slope"), ("float32", "curvature"), ("float64", "curvature")),
    timed=0.3 * AXIS,
)

CASES = (SCREW,)
