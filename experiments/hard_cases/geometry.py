"""Hard cases of cameras and rays."""

import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import distortion, rays

FOCAL_PX = 512.0
CENTER_PX = (320.0, 240.0)
TURN = np.array([[2, -1, 2], [2, 2, -1], [-1, 2, 2]]) / 3


def _pinhole(rotation, position):
    kind = position.dtype
    return cameras.Camera(
        camera_from_world=constant(rotation, kind),
        position=position,
        focal_px=constant(FOCAL_PX, kind),
        principal_point_px=constant(CENTER_PX, kind),
        skew_px=constant(np.zeros(()), kind),
        pixel_aspect=constant(np.ones(()), kind),
        radial=constant(np.zeros(3), kind),
        tangential=constant(np.zeros(2), kind),
    )


def _far_pixel(inputs):
    """Project a point seen by a camera at a position."""
    return cameras.project(_pinhole(TURN, inputs[3:]), inputs[:3])[0]


def _textbook_far_pixel(inputs):
    """K [R | t], with t = -R c."""
    rotation = constant(TURN, inputs.dtype)
    point = rotation @ inputs[:3] + -rotation @ inputs[3:]
    return _on_plane(point[:2], point[2])


def _on_plane(lateral, depth):
    return FOCAL_PX * lateral / depth + constant(CENTER_PX, lateral.dtype)


def _exact_pixel(x, y, divisor):
    return [
        FOCAL_PX * x / divisor + CENTER_PX[0],
        FOCAL_PX * y / divisor + CENTER_PX[1],
    ]


def _exact_far_pixel(inputs):
    offset = mpmath.matrix(inputs[:3]) - mpmath.matrix(inputs[3:])
    return _exact_pixel(*(mpmath.matrix(TURN.tolist()) * offset))


_DISTANCES = np.array([1.0, 100, 1e4, 1e6])
_POSITIONS = _DISTANCES[:, None] * np.array([1.0, -1, 1])
FAR_CAMERA = Case(
    name="camera far from the origin",
    breaks="R x + t cancels. The error is 0.16 px at 1e4 units and 14 px at 1e6.",
    formula="R (x - c) is computed",
    axis="distance / scene units",
    at=_DISTANCES,
    points=np.concatenate([_POSITIONS + np.array([0.5, 0.25, 4]), _POSITIONS], axis=1),
    stable=_far_pixel,
    textbook=_textbook_far_pixel,
    exact=_exact_far_pixel,
    bounds={"float32": (1e-6, 1e-6, 3e-7), "float64": (2e-15, 2e-15, 1e-15)},
)


def _near_pixel(point):
    return cameras.project(_pinhole(np.eye(3), jnp.zeros_like(point)), point)[0]


def _exact_near_pixel(point):
    x, y, depth = point
    reach = max(abs(x), abs(y))
    least = max(reach / mpmath.mpf(cameras.MAX_SLOPE), mpmath.mpf(cameras.MIN_DEPTH))
    return _exact_pixel(x, y, max(depth, least))


_EDGE = 1 / cameras.MAX_SLOPE
_DEPTHS = np.array(
    [-1, -1e-6, -1e-30, 0, 1e-30, 1e-8, _EDGE * (1 - 1e-6), _EDGE * (1 + 1e-6), 0.1, 2]
)
NEAR_PLANE = Case(
    name="point at or behind the camera",
    breaks="x/z is infinite at z = 0, and points behind the camera land inside the "
    "image.",
    formula="The depth is at least 1e-4 of the lateral offset and 1e-12",
    switch=f"switch at a lateral offset of {cameras.MAX_SLOPE:g} depths",
    axis="z / scene units",
    at=_DEPTHS,
    points=np.stack([np.ones(10), np.full(10, -0.5), _DEPTHS], axis=1),
    stable=_near_pixel,
    textbook=lambda point: _on_plane(point[:2], point[2]),
    exact=_exact_near_pixel,
    bounds={"float32": (1e-6, 1e-6, 4e-7), "float64": (2e-15, 2e-15, 1e-15)},
    timed=np.array([1, -0.5, 2]),
)

BARREL = -0.5  # k1; folds at a slope of √(2/3), distorted to 0.5443


def _undistort(distorted_slopes):
    lens = (
        constant([BARREL, 0, 0], distorted_slopes.dtype),
        constant(np.zeros(2), distorted_slopes.dtype),
    )
    return distortion.undistort(*lens, distorted_slopes)[0]


def _fixed_point(distorted_slopes):
    """Ten steps as in OpenCV."""
    slopes = distorted_slopes
    for _ in range(10):
        slopes = distorted_slopes / (1 + BARREL * jnp.sum(slopes**2))
    return slopes


def _exact_undistorted(distorted_slopes):
    """The middle root of r³ - 2 r + 2 t = 0, by Viète's cosines."""
    target = mpmath.sqrt(distorted_slopes[0] ** 2 + distorted_slopes[1] ** 2)
    if target == 0:
        return [mpmath.mpf(0)] * 2
    third = mpmath.acos(-target * mpmath.sqrt(mpmath.mpf(27) / 8)) / 3
    radius = mpmath.sqrt(mpmath.mpf(8) / 3) * mpmath.cos(third - 2 * mpmath.pi / 3)
    return [radius / target * x for x in distorted_slopes]


_BENT = np.array([0, 1e-20, 1e-6, 0.1, 0.3, 0.5, 0.54, 0.544])
LENS_FOLD = Case(
    name="undistortion up to the fold",
    breaks="Fixed-point iterations converge slowly. Ten of them are 4 % off near the "
    "fold.",
    formula="Bracketed Newton iterations are used, with the derivative of the "
    "implicit function",
    axis="distorted radius",
    at=_BENT,
    along=np.array([0.6, -0.8]),
    stable=_undistort,
    textbook=_fixed_point,
    exact=_exact_undistorted,
    bounds={"float32": (4e-6, 2e-4, 3e-4), "float64": (4e-15, 1e-13, 2e-13)},
    timed=0.3 * np.array([0.6, -0.8]),
)

LOW, HIGH = np.full(3, -1.0), np.full(3, 1.0)
START = np.array([-3.0, 1.0, 0.5])  # in the plane of the face y = 1


def _span(direction):
    start, low, high = (constant(x, direction.dtype) for x in (START, LOW, HIGH))
    return jnp.stack(rays.intersect_aabb(start, direction, low, high))


def _slabs(direction):
    start, low, high = (constant(x, direction.dtype) for x in (START, LOW, HIGH))
    ends = jnp.stack([(low - start) / direction, (high - start) / direction])
    return jnp.stack([jnp.max(jnp.min(ends, axis=0)), jnp.min(jnp.max(ends, axis=0))])


def _exact_span(direction):
    enter, leave = mpmath.mpf(0), mpmath.inf
    for along, start, low, high in zip(direction, START, LOW, HIGH, strict=True):
        if abs(along) > mpmath.mpf(10) ** -25:
            ends = sorted([(low - start) / along, (high - start) / along])
            enter, leave = max(enter, ends[0]), min(leave, ends[1])
    return [enter, leave]


_SLANTS = np.array([0, 1e-38, 1e-30, 1e-20, 1e-10, 1e-3, 0.25])
BOX = Case(
    name="ray along a face of the box",
    breaks="A ray in the plane of a face gives 0/0, and gradients of quotients by "
    "1e-20 overflow.",
    formula="Planes parallel to the ray are not intersected",
    switch=f"switch at a direction component of {rays.PARALLEL:g}",
    axis="component across",
    at=_SLANTS,
    points=np.stack([np.ones(7), -_SLANTS, 0.5 * _SLANTS], axis=1),
    stable=_span,
    textbook=_slabs,
    exact=_exact_span,
    bounds={"float32": (1e-6, 1e-6), "float64": (2e-15, 2e-15)},
)

CASES = (FAR_CAMERA, NEAR_PLANE, LENS_FOLD, BOX)
