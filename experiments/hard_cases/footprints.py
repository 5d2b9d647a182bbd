"""Hard cases of Gaussians on the image: footprints, places, directions."""

import dataclasses

import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from gaussians_jax.core.splats import Gaussians
from gaussians_jax.splatting import harmonics, projection
from gaussians_jax.splatting.raster_spec import GSPLAT
from nerfies_jax.geometry.camera import Camera

SIZE = (64, 48)
FOCAL, DEPTH = 64.0, 2.0  # px, scene units: 32 px per unit at the mean
PX = FOCAL / DEPTH
SHARP = dataclasses.replace(GSPLAT, antialiased=True)


def _camera(dtype, position=(0.0, 0.0, 0.0), turn=np.eye(3)):
    fields = (turn, position, FOCAL, [32.0, 24.0], 0.0, 1.0, [0.0] * 3, [0.0] * 2)
    return Camera(*(constant(x, dtype) for x in fields))


def _footprint(x, spec):
    """Project a centered Gaussian of quaternion [4], scale [3] and opacity 0.5."""
    ahead = constant([[0, 0, DEPTH]], x.dtype)
    half = constant([0.5], x.dtype)
    gaussians = Gaussians(ahead, x[None, :4], x[None, 4:7], half)
    return projection.project(gaussians, _camera(x.dtype), SIZE, spec)


def _covariance(x):
    """[[a, b], [b, c]] in px² by way of the 3D covariance, undilated."""
    w, i, j, k = x[:4] / jnp.sqrt(jnp.sum(x[:4] ** 2))
    rows = [
        [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
        [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
        [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)],
    ]
    rotation = jnp.stack([jnp.stack(row) for row in rows])
    spread = rotation @ jnp.diag(x[4:7] ** 2) @ rotation.T
    return PX**2 * spread[:2, :2]


def _exact_covariance(x):
    w, i, j, k = (v / mpmath.sqrt(mpmath.fdot(x[:4], x[:4])) for v in x[:4])
    rows = [
        [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
        [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
    ]
    variances = [s**2 for s in x[4:7]]

    def entry(m, n):
        return PX**2 * sum(
            rows[m][axis] * rows[n][axis] * variances[axis] for axis in range(3)
        )

    return entry(0, 0), entry(0, 1), entry(1, 1)


def _gaussian(x):
    """Its value at an offset [2] in px from the mean."""
    p, k, r = _footprint(x, GSPLAT).whitening[0]
    dx, dy = x[7], x[8]
    return jnp.exp(-((p * dx) ** 2) - (r * (dy - k * dx)) ** 2)[None]


def _gaussian_textbook(x):
    (a, b), (_, c) = _covariance(x) + GSPLAT.eps2d * jnp.eye(2, dtype=x.dtype)
    dx, dy = x[7], x[8]
    form = (c * dx**2 - 2 * b * dx * dy + a * dy**2) / (a * c - b**2)
    return jnp.exp(-form / 2)[None]


def _exact_gaussian(x):
    a, b, c = _exact_covariance(x)
    a, c = (v + mpmath.mpf(GSPLAT.eps2d) for v in (a, c))
    dx, dy = x[7:]
    form = (c * dx**2 - 2 * b * dx * dy + a * dy**2) / (a * c - b**2)
    return [mpmath.exp(-form / 2)]


_TURN = 0.7  # rad about the optical axis
_QUATERNION = np.array([np.cos(_TURN / 2), 0.0, 0.0, np.sin(_TURN / 2)])
_ALONG, _ACROSS = (
    np.array([np.cos(_TURN), np.sin(_TURN)]),
    np.array([-np.sin(_TURN), np.cos(_TURN)]),
)
_LENGTHS = np.array([1, 10, 100, 1e3, 3e3, 1e4, 1e6])


def _needle(length, width=0.02):
    return [*_QUATERNION, length / PX, width / PX, width / PX]


_OFFSET = 20 * _ALONG + 0.4 * _ACROSS  # px

NEEDLE = Case(
    name="needle-shaped Gaussian",
    breaks="ac - b² has no digits left from 3000 px on. Values exceed 1, and "
    "gradients are infinite.",
    formula="u = p dx and v = r (dy - k dx) are used, with c - b²/a as a sum of "
    "squares",
    axis="length / px",
    at=_LENGTHS,
    points=np.array([[*_needle(length), *_OFFSET] for length in _LENGTHS]),
    stable=_gaussian,
    textbook=_gaussian_textbook,
    exact=_exact_gaussian,
    bounds={"float32": (1e-5, 1e-4), "float64": (1e-14, 1e-13)},
    floors=(1e-3, 1e-3, 0.0),
    timed=np.array([*_needle(10.0), 3.0, 1.0]),
)


def _antialiased_textbook(x):
    flat = _covariance(x)
    dilated_covariance = flat + SHARP.eps2d * jnp.eye(2, dtype=x.dtype)
    ratio = jnp.linalg.det(flat) / jnp.linalg.det(dilated_covariance)
    return 0.5 * jnp.sqrt(jnp.maximum(ratio, projection.MIN_COMPENSATION_SQ))[None]


def _exact_antialiased(x):
    a, b, c = _exact_covariance(x)
    wide = mpmath.mpf(SHARP.eps2d)
    ratio = (a * c - b**2) / ((a + wide) * (c + wide) - b**2)
    return [mpmath.sqrt(ratio) / 2]


_RATIOS = np.array([1, 1e2, 1e3, 1e4, 1e6])

ANTIALIASED = Case(
    name="antialiasing factor of a needle-shaped Gaussian",
    breaks="det J Σ Jᵀ is 9 % off at a ratio of 1e3, and has any sign at 1e4.",
    formula="|cross(t1, t2)|² of the rows of T = J W R diag(s) is computed, without Σ",
    axis="length over width",
    at=_RATIOS,
    points=np.array([_needle(0.25 * ratio, 0.25) for ratio in _RATIOS]),
    stable=lambda x: _footprint(x, SHARP).opacity,
    textbook=_antialiased_textbook,
    exact=_exact_antialiased,
    bounds={"float32": (1e-6, 1e-6, 9e-7), "float64": (1e-15, 1e-15, 2e-15)},
    timed=np.array(_needle(2.5, 0.25)),
)

# A turn by an angle of tangent 3/4, with 0.6 and 0.8 as float32 holds them.
_THREE, _FOUR = float(np.float32(0.6)), float(np.float32(0.8))
_ROTATION = np.array([[_FOUR, 0, _THREE], [0, 1, 0], [-_THREE, 0, _FOUR]])
_BESIDE = np.array([0.25, -0.5, 2.0])
_DISTANCES = np.array([0.0, 1e2, 1e4, 1e6])
_PLACE = np.array([1.0, -1.0, 1.0])


def _offset_camera(x):
    """Project a Gaussian from a camera at [3]; the mean is the second part of the
    input.
    """
    return _camera(x.dtype, turn=_ROTATION)._replace(position=x[:3])


def _mean_px(x):
    gaussians = Gaussians(
        x[None, 3:],
        constant([[1, 0, 0, 0]], x.dtype),
        constant(np.full((1, 3), 0.125), x.dtype),
        constant(np.full(1, 0.5), x.dtype),
    )
    return projection.project(gaussians, _offset_camera(x), SIZE, GSPLAT).mean_px[0]


def _mean_px_textbook(x):
    turn = constant(_ROTATION, x.dtype)
    shift = -turn @ x[:3]
    point = turn @ x[3:] + shift
    return FOCAL * point[:2] / point[2] + constant([32, 24], x.dtype)


def _exact_mean_px(x):
    offset = [p - c for p, c in zip(x[3:], x[:3], strict=True)]
    point = [mpmath.fdot(row, offset) for row in _ROTATION.tolist()]
    return [FOCAL * point[0] / point[2] + 32, FOCAL * point[1] / point[2] + 24]


FAR_MEAN = Case(
    name="mean in px, far from the origin",
    breaks="R x + t is off by 0.16 px at 1e4 units and by 14 px at 1e6.",
    formula="R (x - c) is computed",
    axis="distance / scene units",
    at=_DISTANCES,
    points=np.array(
        [[*(d * _PLACE), *(d * _PLACE + _BESIDE @ np.eye(3))] for d in _DISTANCES]
    ),
    stable=_mean_px,
    textbook=_mean_px_textbook,
    exact=_exact_mean_px,
    bounds={"float32": (1e-6, 1e-6, 6e-7), "float64": (1e-15, 1e-15, 1e-15)},
    alike=False,  # a whole footprint against its center
)


_REACHES = np.array([1e-20, 1e-18, 1e-10, 1e-3, 1, 1e3, 1e18, 1e25])
_TOWARD = np.array([0.36, -0.48, 0.8])

DIRECTION = Case(
    name="direction of a short or long offset",
    breaks="|v|² is 0 below 1e-19 and infinite above 1e19 (f32).",
    formula="v is divided by its largest component first",
    axis="|v| / scene units",
    at=_REACHES,
    along=_TOWARD,
    stable=harmonics.unit_direction,
    textbook=lambda v: v / jnp.sqrt(jnp.sum(v**2)),
    exact=lambda v: [c / mpmath.sqrt(mpmath.fdot(v, v)) for c in v],
    bounds={"float32": (4e-7, 1e-6), "float64": (1e-15, 2e-15)},
    timed=_TOWARD,
)

CASES = (NEEDLE, ANTIALIASED, FAR_MEAN, DIRECTION)
