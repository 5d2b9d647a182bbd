"""Jacobi decompositions of a 3×3 matrix, in columns of scalars.

A column is a tuple of three scalars, so that all operations fuse under `vmap`.
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax

from nerfies_jax.geometry.precision import near_one, power_of_two

_SWEEPS = {"float32": 4, "float64": 5}  # quadratic convergence; 3 and 4 nearly suffice


@jax.custom_jvp
def svd(matrix):
    """Compute the singular value decomposition by one-sided Jacobi rotations.

    It rotates the columns of M until they are orthogonal. It never forms MᵀM, whose
    condition number is the square of that of M: in float32 a singular value of 1e-3 has
    a relative error of 3e-5, compared with 0.2 from the eigenvalues of MᵀM.

    Args:
      matrix: A matrix M, [3, 3].

    Returns:
      Columns of U, the three singular values and columns of V, with M = U diag(σ) Vᵀ. U
      and V are rotations, so the smallest value carries the sign of the determinant.

    References:
      Hestenes 1958.
    """
    entries, scale = near_one(matrix)  # keeps fourth powers in range
    columns = [tuple(entries[row, k] for row in range(3)) for k in range(3)]
    one, zero = jnp.ones_like(scale), jnp.zeros_like(scale)
    right = [tuple(one if row == k else zero for row in range(3)) for k in range(3)]

    def sweep(_, state):
        columns, right, _ = map(list, state)
        for p, q in ((0, 1), (0, 2), (1, 2)):
            cosine, sine = _angle(
                dot(columns[q], columns[q]) - dot(columns[p], columns[p]),
                2 * dot(columns[p], columns[q]),
            )
            _rotate(columns, p, q, cosine, sine)
            _rotate(right, p, q, cosine, sine)
        return columns, right, [dot(column, column) for column in columns]

    # The loop returns the lengths, so that all comparisons see the same numbers. XLA
    # could recompute them with other roundings for each comparison, and swap nearly
    # equal columns in one place but not in another.
    start = columns, right, [zero, zero, zero]
    columns, right, lengths = lax.fori_loop(0, _SWEEPS[one.dtype.name], sweep, start)
    for p, q in ((0, 1), (0, 2), (1, 2)):
        # Rotated by 90 degrees, not swapped, so that the basis stays a rotation.
        swap = lengths[p] < lengths[q]
        pair = lengths[p], lengths[q]
        lengths[p], lengths[q] = jnp.maximum(*pair), jnp.minimum(*pair)
        cosine, sine = jnp.where(swap, 0, one), jnp.where(swap, one, 0)
        _rotate(columns, p, q, cosine, sine)
        _rotate(right, p, q, cosine, sine)
    left, values = _complete(columns)
    return left, tuple(value * scale for value in values), right


@svd.defjvp
def _svd_jvp(primals, tangents):
    raise NotImplementedError(
        "singular vectors have no derivative where singular values are equal; use "
        "singular_values (once differentiable) or the energies (twice)"
    )


def _complete(columns):
    """Compute U and σ from orthogonal columns by descending length, zeros included."""
    one, zero = jnp.ones_like(columns[0][0]), jnp.zeros_like(columns[0][0])
    u1, length1 = _unit(columns[0], (one, zero, zero))
    x, y, z = u1
    upright = jnp.abs(z) > 0.5
    spare, _ = _unit(
        (
            jnp.where(upright, z, y),
            jnp.where(upright, 0, -x),
            jnp.where(upright, -x, 0),
        ),
        (zero, one, zero),
    )
    second, length2 = _unit(columns[1], spare)
    overlap = dot(u1, second)
    residual = tuple(s - overlap * u for s, u in zip(second, u1, strict=True))
    sine = jnp.sqrt(dot(residual, residual))
    # A second column parallel to u1 consists of rounding errors, and any perpendicular
    # direction may replace it. Its length is no criterion: [0, 0.02, 0] is exact next
    # to [5e4, 0, 0].
    independent = sine > 0.5
    side = jnp.where(dot(spare, second) < 0, -one, one)
    u2, _ = _unit(
        tuple(
            jnp.where(independent, r, side * s)
            for s, r in zip(spare, residual, strict=True)
        ),
        spare,
    )
    u3 = cross(u1, u2)
    return [u1, u2, u3], (length1, length2 * sine, dot(u3, columns[2]))


def eigen(matrix):
    """Compute the eigenvalue decomposition of a symmetric matrix by Jacobi rotations.

    Args:
      matrix: A symmetric matrix, [3, 3].

    Returns:
      The three eigenvalues, in no particular order, and the eigenvectors as columns.
    """
    a = [[matrix[i, j] for j in range(3)] for i in range(3)]
    one, zero = jnp.ones_like(a[0][0]), jnp.zeros_like(a[0][0])
    basis = [tuple(one if row == k else zero for row in range(3)) for k in range(3)]

    def sweep(_, state):
        a, basis = [list(row) for row in state[0]], list(state[1])
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            cosine, sine = _angle(a[q][q] - a[p][p], 2 * a[p][q])
            tangent = sine / cosine  # at most 1, for a rotation by 45 degrees
            shift = tangent * a[p][q]
            a[p][p], a[q][q] = a[p][p] - shift, a[q][q] + shift
            a[p][q] = a[q][p] = zero
            rp = cosine * a[r][p] - sine * a[r][q]
            rq = sine * a[r][p] + cosine * a[r][q]
            a[r][p] = a[p][r] = rp
            a[r][q] = a[q][r] = rq
            _rotate(basis, p, q, cosine, sine)
        return a, basis

    a, basis = lax.fori_loop(0, _SWEEPS[matrix.dtype.name], sweep, (a, basis))
    return (a[0][0], a[1][1], a[2][2]), basis


def _angle(difference, twice_product):
    """Compute cosine and sine of the smaller angle that orthogonalizes two columns."""
    size = jnp.abs(difference) + jnp.sqrt(difference**2 + twice_product**2)
    equal = size == 0
    signed_product = jnp.where(difference < 0, -twice_product, twice_product)
    tangent = jnp.where(equal, 0, signed_product / jnp.where(equal, 1, size))
    cosine = 1 / jnp.sqrt(1 + tangent**2)
    return cosine, cosine * tangent


def _rotate(columns, p, q, cosine, sine):
    pairs = list(zip(columns[p], columns[q], strict=True))
    columns[p] = tuple(cosine * x - sine * y for x, y in pairs)
    columns[q] = tuple(sine * x + cosine * y for x, y in pairs)


def _unit(vector, fallback):
    # Scaled first: in float32 the squares of a column of length 1e-20 are zero.
    scale = power_of_two(functools.reduce(jnp.maximum, map(jnp.abs, vector)))
    scaled_vector = [v / scale for v in vector]
    length = jnp.sqrt(dot(scaled_vector, scaled_vector))
    is_zero = length == 0
    divisor = jnp.where(is_zero, 1, length)
    unit = (
        jnp.where(is_zero, o, v / divisor)
        for o, v in zip(fallback, scaled_vector, strict=True)
    )
    return tuple(unit), length * scale


def dot(a, b):
    """Return the inner product of two vectors.

    Args:
      a: Sequence of three scalars or arrays.
      b: Sequence of three scalars or arrays.

    Returns:
      a · b.
    """
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    """Return the cross product of two vectors.

    Args:
      a: Sequence of three scalars or arrays.
      b: Sequence of three scalars or arrays.

    Returns:
      a × b as a tuple of three.
    """
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )
