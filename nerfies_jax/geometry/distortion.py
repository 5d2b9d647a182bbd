"""Brown-Conrady lens distortion of image-plane slopes, and its inverse.

Slopes are (X/Z, Y/Z) of a point in the camera's frame. `radial` is k1 k2 k3 and
`tangential` p1 p2, as in OpenCV and in Nerfies' camera files.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from nerfies_jax.geometry.precision import exact_product, refuse_half

# A bracketed Newton: 5 steps for a phone lens; the rest is for strong lenses, close to
# their fold, where the root is nearly double and each step only halves the distance.
RADIAL_STEPS = 24
PLANE_STEPS = 6  # tangential terms of 1e-2 need three; of 4e-2, near the fold, six
INSIDE = 0.97
MAX_RADIUS = 1e4  # slopes beyond 89.99 degrees overflow r⁷ in float32
# Below this the plane is compressed a thousandfold: at the fold for any purpose.
MIN_DETERMINANT = 1e-3
PIECES = 3  # of the way from the axis, each with its own bound of the determinant
DEGREE = 12  # of the determinant along the way
RESIDUAL_ULPS = 32  # of 1 + |slopes|: 0.01 px in float32 at a focal length of 2700 px


def to_bernstein(degree: int, pieces: int) -> np.ndarray:
    """Convert coefficients of t^k to those of Bernstein on equal pieces of [0, 1].

    Args:
      degree: Degree of the polynomial.
      pieces: Number of pieces.

    Returns:
      A matrix [pieces * (degree + 1), degree + 1]. A polynomial lies between the least
      and the largest coefficient of each piece.
    """
    rows = []
    for piece in range(pieces):
        for j in range(degree + 1):
            row = np.zeros(degree + 1)
            for k in range(degree + 1):  # (piece + u)^k / pieces^k in powers of u
                for i in range(min(j, k) + 1):
                    share = math.comb(j, i) / math.comb(degree, i)
                    row[k] += math.comb(k, i) * piece ** (k - i) * share / pieces**k
            rows.append(row)
    return np.array(rows)


_TO_BERNSTEIN = to_bernstein(DEGREE, PIECES)


def distort(
    radial: Float[Array, "3"], tangential: Float[Array, "2"], slopes: Float[Array, "2"]
) -> Float[Array, "2"]:
    """Apply lens distortion to one point of the image plane.

    Args:
      radial: Coefficients k1, k2, k3, [3].
      tangential: Coefficients p1, p2, [2].
      slopes: Undistorted image-plane position (X/Z, Y/Z), [2].

    Returns:
      The distorted position in the image plane, [2].

    References:
      Brown 1971, in the parameterization of OpenCV.
    """
    x, y = slopes[0], slopes[1]
    radius_sq = x * x + y * y
    k1, k2, k3 = radial[0], radial[1], radial[2]
    p1, p2 = tangential[0], tangential[1]
    stretch = 1 + radius_sq * (k1 + radius_sq * (k2 + radius_sq * k3))
    return jnp.stack(
        [
            x * stretch + 2 * p1 * x * y + p2 * (radius_sq + 2 * x * x),
            y * stretch + 2 * p2 * x * y + p1 * (radius_sq + 2 * y * y),
        ]
    )


def undistort(
    radial: Float[Array, "3"], tangential: Float[Array, "2"], bent: Float[Array, "2"]
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """Invert `distort` for one point of the image plane.

    The solution is sought on the branch that contains the optical axis. Beyond the edge
    of that branch there is none. Other roots, where Newton's method from the distorted
    point often lands, belong to no ray of light. Derivatives of any order are those of
    the implicit function, and zero where there is no solution.

    Args:
      radial: Coefficients k1, k2, k3, [3].
      tangential: Coefficients p1, p2, [2].
      bent: Distorted position in the image plane, [2], in float32 or float64.

    Returns:
      The undistorted position (X/Z, Y/Z) [2], and a boolean that is False if no
      solution was found.

    Raises:
      ValueError: If an argument is bfloat16 or float16.
    """
    refuse_half("the distorted point or the lens", bent, radial)
    slopes = _undistort(radial, tangential, bent)
    return slopes, _solves(radial, tangential, bent, slopes)


def one_to_one(
    radial: Float[Array, "3"], tangential: Float[Array, "2"], slopes: Float[Array, "2"]
) -> Bool[Array, ""]:
    """Test if the lens has not folded anywhere between the axis and a point.

    The test is exact for the radial terms. With tangential terms the determinant of the
    Jacobian must be positive all the way, as far as its Bernstein coefficients on
    `PIECES` parts of the way can tell. Where they cannot, the result is False.

    Args:
      radial: Coefficients k1, k2, k3, [3].
      tangential: Coefficients p1, p2, [2].
      slopes: Undistorted image-plane position (X/Z, Y/Z), [2].

    Returns:
      A boolean scalar.
    """
    at_end = _determinant(_jacobian(radial, tangential, slopes)) > MIN_DETERMINANT
    on_the_way = jnp.all(tangential == 0) | (
        jnp.min(_bernstein(radial, tangential, slopes)) > 0
    )
    return _is_unfolded(radial, jnp.sum(slopes**2)) & at_end & on_the_way


def _bernstein(radial, tangential, slopes):
    """Bernstein coefficients of the Jacobian's determinant on the way to `slopes`.

    The determinant is a polynomial in the share t of the way and lies between the least
    and the largest coefficient of each part.
    """
    x, y = slopes[0], slopes[1]
    radius_sq = x * x + y * y
    powers = radius_sq ** jnp.arange(4, dtype=slopes.dtype)
    radial_terms = jnp.concatenate([jnp.ones_like(radial[:1]), radial]) * powers
    zeros = jnp.zeros_like(radial_terms)
    # In powers of t, along the way and across it: even powers are the radial terms'.
    across = jnp.stack([radial_terms, zeros], axis=1).reshape(-1)[:-1]
    along = across * jnp.arange(1, 8, dtype=slopes.dtype)
    p1, p2 = tangential[0], tangential[1]
    # The tangential Jacobian at `slopes`, linear in t, in the frame of the way.
    xx = 2 * p1 * y + 6 * p2 * x
    xy = 2 * p1 * x + 2 * p2 * y
    yy = 2 * p2 * x + 6 * p1 * y
    length = jnp.sqrt(jnp.where(radius_sq > 0, radius_sq, 1))
    ux, uy = jnp.where(radius_sq > 0, x, 1) / length, y / length
    first = ux * ux * xx + 2 * ux * uy * xy + uy * uy * yy
    second = uy * uy * xx - 2 * ux * uy * xy + ux * ux * yy
    cross_term = ux * uy * (yy - xx) + (ux * ux - uy * uy) * xy
    along, across = along.at[1].add(first), across.at[1].add(second)
    # Not `jnp.convolve`, which becomes a convolution of as many groups as pixels.
    product = sum(jnp.pad(along[i] * across, (i, 6 - i)) for i in range(7))
    product = product.at[2].add(-cross_term * cross_term)
    return exact_product(jnp.asarray(_TO_BERNSTEIN, slopes.dtype), product)


@jax.custom_jvp
def _undistort(radial, tangential, distorted_xy):
    start = _radial_root(radial, distorted_xy)

    def newton(_, slopes):
        jacobian = _jacobian(radial, tangential, slopes)
        step = _solve(jacobian, distort(radial, tangential, slopes) - distorted_xy)
        return slopes - step

    slopes = lax.fori_loop(0, PLANE_STEPS, newton, start)
    # Where there is no solution Newton wanders to other branches, or to infinity.
    return jnp.where(_solves(radial, tangential, distorted_xy, slopes), slopes, start)


@_undistort.defjvp
def _undistort_jvp(primals, tangents):
    """Apply the rule J ds = d distorted - ∂distort/∂(lens) d lens."""
    radial, tangential, distorted_xy = primals
    radial_dot, tangential_dot, distorted_dot = tangents
    slopes = _undistort(radial, tangential, distorted_xy)
    _, tangent = jax.jvp(
        lambda k, p: distort(k, p, slopes),
        (radial, tangential),
        (radial_dot, tangential_dot),
    )
    step = _solve(_jacobian(radial, tangential, slopes), distorted_dot - tangent)
    return slopes, jnp.where(_solves(radial, tangential, distorted_xy, slopes), step, 0)


def _solves(radial, tangential, distorted_xy, slopes):
    """Test if `slopes` is the correct root. False for NaN, as comparisons are."""
    residual = jnp.max(jnp.abs(distort(radial, tangential, slopes) - distorted_xy))
    bound = (
        RESIDUAL_ULPS
        * jnp.finfo(distorted_xy.dtype).eps
        * (1 + jnp.max(jnp.abs(distorted_xy)))
    )
    return (residual <= bound) & one_to_one(radial, tangential, slopes)


def _radial_root(radial, distorted_xy):
    """Find the root without tangential terms by Newton's method and bisection.

    `is_beyond` is True outside of the root, or of the fold if there is no root, so the
    bracket always contains the first of the two.
    """
    target = jnp.sqrt(jnp.sum(distorted_xy**2))
    k1, k2, k3 = radial[0], radial[1], radial[2]

    def narrow(_, state):
        low, high, radius, last = state
        radius_sq = radius * radius
        stretch = 1 + radius_sq * (k1 + radius_sq * (k2 + radius_sq * k3))
        excess = radius * stretch - target
        is_unfolded = _is_unfolded(radial, radius_sq)
        is_beyond = (excess > 0) | ~is_unfolded
        low = jnp.where(is_beyond, low, radius)
        high = jnp.where(is_beyond, radius, high)
        slope = _radial_slope(radial, radius_sq)
        newton = radius - excess / jnp.where(is_unfolded, slope, 1)
        # Newton's method is used while it at least halves its step, because it is slow
        # near an inflection. Without an upper bound the radius is doubled instead.
        use_newton = is_unfolded & (newton >= low) & (newton <= high)
        use_newton &= jnp.abs(newton - radius) < last / 2
        middle = jnp.minimum((low + high) / 2, 2 * low + target)
        step = jnp.where(use_newton, newton, middle)
        return low, high, step, jnp.abs(step - radius)

    low = jnp.zeros_like(target)
    high = jnp.full_like(target, MAX_RADIUS)
    state = low, high, jnp.minimum(target, high), high
    _, _, radius, _ = lax.fori_loop(0, RADIAL_STEPS, narrow, state)
    # Where the tangential terms alone reach the target, the radial search ends at the
    # fold, from where Newton has no way; it starts inside instead.
    radius = jnp.where(
        _is_unfolded(radial, (radius / INSIDE) ** 2), radius, INSIDE * radius
    )
    return distorted_xy * (radius / jnp.where(target > 0, target, 1))


def _radial_slope(radial, radius_sq):
    """d(distorted radius)/d(radius) as a cubic in the squared radius."""
    k1, k2, k3 = radial[0], radial[1], radial[2]
    return 1 + radius_sq * (3 * k1 + radius_sq * (5 * k2 + radius_sq * 7 * k3))


def _is_unfolded(radial, radius_sq):
    """Test if the radial derivative is positive from 0 to `radius_sq`.

    A cubic's least value lies at an end or where its derivative 3k1 + 10k2 s + 21k3 s²
    vanishes.
    """
    a, b, c = 21 * radial[2], 10 * radial[1], 3 * radial[0]
    discriminant = b * b - 4 * a * c
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    half = -(b + jnp.where(b < 0, -root, root)) / 2  # the sum that does not cancel
    ends = [radius_sq]
    for numerator, denominator in ((half, a), (c, half)):
        real = (denominator != 0) & (discriminant > 0)
        at = numerator / jnp.where(real, denominator, 1)
        ends.append(jnp.where(real & (at > 0) & (at < radius_sq), at, 0))
    return jnp.min(_radial_slope(radial, jnp.stack(ends))) > 0


def _jacobian(radial, tangential, slopes):
    return jax.jacfwd(distort, argnums=2)(radial, tangential, slopes)


def _determinant(matrix):
    return matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]


def _solve(matrix, right):
    """Return matrix⁻¹ right for 2×2, or zero where the plane is folded or collapsed."""
    determinant = _determinant(matrix)
    regular = determinant > MIN_DETERMINANT
    x = matrix[1, 1] * right[0] - matrix[0, 1] * right[1]
    y = matrix[0, 0] * right[1] - matrix[1, 0] * right[0]
    step = jnp.stack([x, y]) / jnp.where(regular, determinant, 1)
    return jnp.where(regular, step, 0)
