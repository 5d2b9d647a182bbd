"""Fisheye distortion of image-plane slopes, and its inverse.

Slopes are (X/Z, Y/Z) of a point in the camera's frame. With the angle θ between a ray
and the optical axis, the distorted radius is θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), as
in `cv2.fisheye` and COLMAP's OPENCV_FISHEYE. Only what is in front of the camera,
θ < 90 degrees, has slopes.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry.distortion import MAX_RADIUS, RESIDUAL_ULPS, to_bernstein
from nerfies_jax.geometry.precision import exact_product, refuse_half

STEPS = 24  # of a bracketed Newton; 5 suffice away from a fold
SEARCHED = 257  # angles up to 90 degrees, for the first fold
OVERSHOOT = 1e-2  # of the angle, that is clamped to the bracket instead of bisected
# Of arctan(x)/x in x², at most tan² 22.5 degrees; what is left is below 1e-17.
_SERIES = tuple((-1) ** k / (2 * k + 1) for k in range(21))
_WIDEST = math.atan(MAX_RADIUS)  # rad
# Of the derivative of the distorted radius, a polynomial in θ², on parts of the way.
_TO_BERNSTEIN = to_bernstein(degree=4, pieces=4)


class Stretch(NamedTuple):
    """Distorted over undistorted radius, and how it changes, at one squared slope."""

    ratio: Float[Array, ""]  # distorted over undistorted radius
    change: Float[Array, ""]  # derivative of the ratio by the squared slope
    along: Float[Array, ""]  # derivative of the distorted radius by the radius


def distort(
    coefficients: Float[Array, "4"], slopes: Float[Array, "2"]
) -> Float[Array, "2"]:
    """Apply fisheye distortion to one point of the image plane.

    Args:
      coefficients: k1, k2, k3, k4, [4]. Zeros are the equidistant fisheye.
      slopes: Undistorted image-plane position (X/Z, Y/Z), [2].

    Returns:
      The distorted position in the image plane, [2].

    References:
      Kannala and Brandt 2006, in the parameterization of OpenCV.
    """
    return slopes * stretch(coefficients, jnp.sum(slopes * slopes)).ratio


def undistort(
    coefficients: Float[Array, "4"], bent: Float[Array, "2"]
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """Invert `distort` for one point of the image plane.

    Derivatives of any order are those of the implicit function, and zero where there is
    no solution.

    Args:
      coefficients: k1, k2, k3, k4, [4].
      bent: Distorted position in the image plane, [2], in float32 or float64.

    Returns:
      The undistorted position (X/Z, Y/Z) [2], and a boolean that is False if no ray
      less than 90 degrees off the axis lands there.

    Raises:
      ValueError: If an argument is bfloat16 or float16.
    """
    refuse_half("the distorted point or the lens", bent, coefficients)
    slopes = _undistort(coefficients, bent)
    return slopes, _solves(coefficients, bent, slopes)


def one_to_one(
    coefficients: Float[Array, "4"], slopes: Float[Array, "2"]
) -> Bool[Array, ""]:
    """Test if the lens has not folded anywhere between the axis and a point.

    The derivative of the distorted radius must be positive all the way, as far as its
    Bernstein coefficients can tell. Where they cannot, the result is False.

    Args:
      coefficients: k1, k2, k3, k4, [4].
      slopes: Undistorted image-plane position (X/Z, Y/Z), [2].

    Returns:
      A boolean scalar.
    """
    slope_sq = jnp.sum(slopes * slopes)
    ratio, _ = _arctan_ratio(slope_sq)
    return _is_unfolded(coefficients, slope_sq * ratio * ratio)


def stretch(coefficients: Float[Array, "4"], squared: Float[Array, ""]) -> Stretch:
    """Evaluate the radial distortion and its derivatives.

    Args:
      coefficients: k1, k2, k3, k4, [4].
      squared: Squared slope tan² θ, a scalar.

    Returns:
      The ratio of the radii and its derivatives.
    """
    ratio, slope = _arctan_ratio(squared)
    angle_sq = squared * ratio * ratio
    k1, k2, k3, k4 = (coefficients[i] for i in range(4))
    factor = 1 + angle_sq * (k1 + angle_sq * (k2 + angle_sq * (k3 + angle_sq * k4)))
    growth = k1 + angle_sq * (2 * k2 + angle_sq * (3 * k3 + angle_sq * 4 * k4))
    # d(θ²)/d(tan² θ) = θ / (tan θ (1 + tan² θ))
    change = slope * factor + ratio * growth * ratio / (1 + squared)
    along = (factor + 2 * angle_sq * growth) / (1 + squared)
    return Stretch(ratio * factor, change, along)


def _arctan_ratio(slope_sq):
    """θ / tan θ and its derivative as functions of tan² θ."""
    return jax.jvp(_quarter_series, (slope_sq,), (jnp.ones_like(slope_sq),))


def _quarter_series(slope_sq):
    """θ / tan θ from the series of a quarter of the angle.

    Smooth at zero, without a switch. `jnp.arctan` would be shorter, but XLA:CPU of JAX
    0.10 compiles it to wrong numbers with vectors of 512 bits.
    """
    first = 1 + jnp.sqrt(1 + slope_sq)  # tan θ over tan θ/2
    half = slope_sq / (first * first)
    second = 1 + jnp.sqrt(1 + half)
    quarter = half / (second * second)
    series = jnp.zeros_like(slope_sq)
    for coefficient in reversed(_SERIES):
        series = series * quarter + coefficient
    return 4 * series / (first * second)


def _is_unfolded(coefficients, angle_sq):
    """Test if the derivative of the distorted radius is positive from 0 to θ²."""
    powers = angle_sq ** jnp.arange(5, dtype=angle_sq.dtype)
    odd = jnp.arange(1, 10, 2, dtype=angle_sq.dtype)
    terms = jnp.concatenate([jnp.ones_like(coefficients[:1]), coefficients]) * odd
    bounds = exact_product(jnp.asarray(_TO_BERNSTEIN, angle_sq.dtype), terms * powers)
    return jnp.min(bounds) > 0


@jax.custom_jvp
def _undistort(coefficients, distorted_xy):
    target = jnp.sqrt(jnp.sum(distorted_xy**2))

    def narrow(_, state):
        low, high, angle = state
        distorted_radius, slope = _radius(coefficients, angle)
        excess = distorted_radius - target
        is_beyond = (excess > 0) | (slope <= 0)
        low, high = jnp.where(is_beyond, low, angle), jnp.where(is_beyond, angle, high)
        newton = angle - excess / jnp.where(slope > 0, slope, 1)
        # At the root, rounding alone may lead out of the bracket: `excess` is computed
        # anew, with other roundings, wherever the compiler reads it.
        in_bracket = jnp.clip(newton, low, high)
        use_newton = (slope > 0) & (jnp.abs(newton - in_bracket) <= OVERSHOOT * angle)
        return low, high, jnp.where(use_newton, in_bracket, (low + high) / 2)

    # No angle beyond the first fold is searched.
    angles = jnp.linspace(0, _WIDEST, SEARCHED, dtype=distorted_xy.dtype)
    _, slopes = _radius(coefficients, angles)
    high = jnp.min(jnp.where(slopes <= 0, angles, _WIDEST))
    state = jnp.zeros_like(target), high, jnp.minimum(target, high)
    _, _, angle = lax.fori_loop(0, STEPS, narrow, state)
    radius = jnp.tan(jnp.minimum(angle, high))
    return distorted_xy * jnp.where(
        target > 0, radius / jnp.where(target > 0, target, 1), 1
    )


def _radius(coefficients, angle):
    """Distorted radius at an angle, and its derivative."""
    k1, k2, k3, k4 = (coefficients[i] for i in range(4))
    u = angle * angle
    radius = angle * (1 + u * (k1 + u * (k2 + u * (k3 + u * k4))))
    return radius, 1 + u * (3 * k1 + u * (5 * k2 + u * (7 * k3 + u * 9 * k4)))


@_undistort.defjvp
def _undistort_jvp(primals, tangents):
    """Apply the rule J ds = d distorted - ∂distort/∂k dk. J is in its radial frame."""
    coefficients, distorted_xy = primals
    coefficients_dot, distorted_dot = tangents
    slopes = _undistort(coefficients, distorted_xy)
    _, tangent = jax.jvp(
        lambda k: distort(k, slopes), (coefficients,), (coefficients_dot,)
    )
    right = distorted_dot - tangent
    slope_sq = jnp.sum(slopes * slopes)
    has_solution = _solves(coefficients, distorted_xy, slopes)
    ratio, _, along = stretch(coefficients, slope_sq)
    ratio, along = jnp.where(has_solution, ratio, 1), jnp.where(has_solution, along, 1)
    # 1/ratio across and 1/along along the slopes; both are 1 at the axis.
    radial = slopes * jnp.sum(slopes * right) / jnp.where(slope_sq > 0, slope_sq, 1)
    step = right / ratio + radial * (1 / along - 1 / ratio)
    return slopes, jnp.where(has_solution, step, 0)


def _solves(coefficients, distorted_xy, slopes):
    """Test if `slopes` is the correct root. False for NaN, as comparisons are."""
    residual = jnp.max(jnp.abs(distort(coefficients, slopes) - distorted_xy))
    bound = (
        RESIDUAL_ULPS
        * jnp.finfo(distorted_xy.dtype).eps
        * (1 + jnp.max(jnp.abs(distorted_xy)))
    )
    return (residual <= bound) & one_to_one(coefficients, slopes)
