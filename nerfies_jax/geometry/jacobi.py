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

    It rotates columns until they are orthogonal and never forms MᵀM, whose condition
    number is squared. A singular value of 1e-3 keeps a relative error of 3e-5 in
    float32, where the way through JᵀJ leaves a fifth.

    Args:
      matrix: A matrix M, [3, 3].

    Returns:
      Columns of U, the three singular values and columns of V, with M = U diag(σ) Vᵀ. U
      and V are rotations, so the smallest value carries the sign of the determinant.

    References:
      Hestenes 1958.
    """
    entries, scale = near_one(matrix)  # squares of squares stay in range
    columns = [tuple(entries[row, k] for row in range(3)) for k in range(3)]
    one, zero = jnp.ones_like(scale), jnp.zeros_like(scale)
    right = [tuple(one if row == k else zero for row in range(3)) for k in range(3)]

    def sweep(_, both):
        columns, right, _ = map(list, both)
        for p, q in ((0, 1), (0, 2), (1, 2)):
            cosine, sine = _angle(
                dot(columns[q], columns[q]) - dot(columns[p], columns[p]),
                2 * dot(columns[p], columns[q]),
            )
            _turn(columns, p, q, cosine, sine)
            _turn(right, p, q, cosine, sine)
        return columns, right, [dot(column, column) for column in columns]

    # Lengths leave the loop as numbers: computed anew wherever they are compared, with
    # other roundings, nearly equal ones are swapped in one place and not in another.
    start = columns, right, [zero, zero, zero]
    columns, right, lengths = lax.fori_loop(0, _SWEEPS[one.dtype.name], sweep, start)
    for p, q in ((0, 1), (0, 2), (1, 2)):
        # a quarter turn, not a swap: the basis stays a rotation
        swap = lengths[p] < lengths[q]
        both = lengths[p], lengths[q]
        lengths[p], lengths[q] = jnp.maximum(*both), jnp.minimum(*both)
        cosine, sine = jnp.where(swap, 0, one), jnp.where(swap, one, 0)
        _turn(columns, p, q, cosine, sine)
        _turn(right, p, q, cosine, sine)
    left, values = _complete(columns)
    return left, tuple(value * scale for value in values), right


@svd.defjvp
def _svd_jvp(primals, tangents):
    raise NotImplementedError(
        "singular vectors have no derivative where singular values are equal; use "
        "singular_values (once differentiable) or the energies (twice)"
    )


def _complete(columns):
    """Left vectors of orthogonal columns in falling order, also where some are zero."""
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
    along = dot(u1, second)
    rest = tuple(s - along * u for s, u in zip(second, u1, strict=True))
    across = jnp.sqrt(dot(rest, rest))
    # A column that lies along u1 is nothing but rounding, and any direction across will
    # do. It is not told by its length: [0, 0.02, 0] beside [5e4, 0, 0] is exact.
    own = across > 0.5
    side = jnp.where(dot(spare, second) < 0, -one, one)
    u2, _ = _unit(
        tuple(jnp.where(own, r, side * s) for s, r in zip(spare, rest, strict=True)),
        spare,
    )
    u3 = cross(u1, u2)
    return [u1, u2, u3], (length1, length2 * across, dot(u3, columns[2]))


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

    def sweep(_, both):
        a, basis = [list(row) for row in both[0]], list(both[1])
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            cosine, sine = _angle(a[q][q] - a[p][p], 2 * a[p][q])
            tangent = sine / cosine  # at most one turn of 45 degrees
            moved = tangent * a[p][q]
            a[p][p], a[q][q] = a[p][p] - moved, a[q][q] + moved
            a[p][q] = a[q][p] = zero
            rp = cosine * a[r][p] - sine * a[r][q]
            rq = sine * a[r][p] + cosine * a[r][q]
            a[r][p] = a[p][r] = rp
            a[r][q] = a[q][r] = rq
            _turn(basis, p, q, cosine, sine)
        return a, basis

    a, basis = lax.fori_loop(0, _SWEEPS[matrix.dtype.name], sweep, (a, basis))
    return (a[0][0], a[1][1], a[2][2]), basis


def _angle(difference, twice_product):
    """Cosine and sine of the smaller turn that makes two columns orthogonal."""
    size = jnp.abs(difference) + jnp.sqrt(difference**2 + twice_product**2)
    still = size == 0
    signed = jnp.where(difference < 0, -twice_product, twice_product)
    tangent = jnp.where(still, 0, signed / jnp.where(still, 1, size))
    cosine = 1 / jnp.sqrt(1 + tangent**2)
    return cosine, cosine * tangent


def _turn(columns, p, q, cosine, sine):
    both = list(zip(columns[p], columns[q], strict=True))
    columns[p] = tuple(cosine * x - sine * y for x, y in both)
    columns[q] = tuple(sine * x + cosine * y for x, y in both)


def _unit(vector, otherwise):
    # scaled: the square of a column 1e20 times shorter than another is zero in float32
    scale = power_of_two(functools.reduce(jnp.maximum, map(jnp.abs, vector)))
    scaled = [v / scale for v in vector]
    length = jnp.sqrt(dot(scaled, scaled))
    none = length == 0
    divisor = jnp.where(none, 1, length)
    unit = (
        jnp.where(none, o, v / divisor) for o, v in zip(otherwise, scaled, strict=True)
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
