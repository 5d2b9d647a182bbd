"""Spectral functions of one 3×3 matrix, with derivatives that exist everywhere.

Σ log²σ of a warp's Jacobian is the elastic energy of Nerfies (Park et al. 2021,
arXiv:2011.12948, equations 11-12). Everything is written in scalars, so that a `vmap`
runs over long rows: on a CPU 20 times as fast as LAPACK's batched SVD, with its
gradient 10 times. Sweeps are a loop: unrolled, energies with slopes took 1.3 times as
long, 1.4 to compile. A value and its derivatives come from one decomposition.
"""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from nerfies_jax.geometry.precision import at_least_float32

Matrix = Float[Array, "3 3"]
Scalar = Float[Array, ""]

# Below this stretch the logarithm continues as its tangent: a collapsed or folded
# direction has finite energy and a slope that opens it again. A clamp, log max(σ, ε),
# has slope zero there, and nothing ever un-collapses.
COLLAPSED = 1e-2
# The unsigned energy has a cone at σ = 0, whose curvature 1/σ no optimiser can use.
CONE = 1e-6
# |J - 1| (Frobenius): below, strains are resolved to 1e-8 from J - 1; above, the form
# through JᵀJ loses more by squaring than J itself does by rounding.
SMALL_DISPLACEMENT = 0.1
_SWEEPS = {"float32": 4, "float64": 5}  # quadratic convergence; 3 and 4 nearly suffice


@at_least_float32
def log_energy(matrix: Matrix) -> Scalar:
    """Σ log²σ over the singular values: zero for rotations and for reflections.

    Twice differentiable, also at equal singular values (Daleckii and Krein 1965).
    """
    return _energy(False, matrix)


@at_least_float32
def signed_log_energy(matrix: Matrix) -> Scalar:
    """The same, but the smallest singular value carries the sign of the determinant.

    A fold then costs more than a collapse and slides back through it.
    """
    return _energy(True, matrix)


@at_least_float32
def displacement_log_energy(
    displacement: Matrix, otherwise: Callable[[Matrix], Scalar] = log_energy
) -> Scalar:
    """`log_energy` of 1 + `displacement`, exact for strains far below an ulp of one.

    Take the Jacobian of the *displacement* field: of `warp(x) - x` it would have been
    rounded already. Above `SMALL_DISPLACEMENT` the energy is `otherwise(1 + D)`.
    """
    near = jnp.sum(displacement**2) < SMALL_DISPLACEMENT**2
    small = jnp.where(near, displacement, 0)
    strain = _strain(small)
    large = jnp.where(near, 0, displacement) + jnp.eye(3, dtype=displacement.dtype)
    return jnp.where(near, _strain_energy(strain), otherwise(large))


def _strain(displacement):
    """JᵀJ - 1 of J = 1 + D, without the one."""
    d = _entries(displacement)
    return _stacked(
        _each(lambda i, j: d[i][j] + d[j][i] + sum(row[i] * row[j] for row in d))
    )


@at_least_float32
def singular_values(matrix: Matrix) -> Float[Array, "3"]:
    """In descending order, not negative. Once differentiable, also where equal."""
    return _singular_values(matrix)


@jax.custom_jvp
def _singular_values(matrix):
    return jnp.stack(_oriented(False, matrix)[1])


@_singular_values.defjvp
def _singular_values_jvp(primals, tangents):
    left, values, right = _oriented(False, primals[0])
    turned = _between(left, _entries(tangents[0]), right)
    return jnp.stack(values), jnp.stack([turned[k][k] for k in range(3)])


@at_least_float32
def svd(matrix: Matrix) -> tuple[Matrix, Float[Array, "3"], Matrix]:
    """U, σ, V with M = U diag(σ) Vᵀ, both of them rotations; not differentiable.

    σ1 >= σ2 >= |σ3|, and σ3 has the sign of the determinant.
    """
    left, values, right = _svd(matrix)
    return _matrix(left), jnp.stack(values), _matrix(right)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _energy(signed, matrix):
    return _energy_and_slope(signed, matrix)[0]


@_energy.defjvp
def _energy_jvp(signed, primals, tangents):
    energy, slope = _energy_and_slope(signed, primals[0])
    return energy, jnp.sum(slope * tangents[0])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _energy_and_slope(signed, matrix):
    return _energy_of(*_oriented(signed, matrix))


def _energy_of(left, values, right):
    """Σ f(σ) and U diag(f'(σ)) Vᵀ."""
    slope = _diagonal([_log_sq_slope(value) for value in values])
    energy = sum(_log(value) ** 2 for value in values)
    return energy, _stacked(_outer(left, slope, right))


@_energy_and_slope.defjvp
def _energy_and_slope_jvp(signed, primals, tangents):
    """Divided differences of f' for the symmetric part, sums for the twisting part.

    Smith, De Goes and Kim 2019, "Analytic eigensystems for isotropic distortion
    energies", section 4: the same for any isotropic energy.
    """
    left, values, right = _oriented(signed, primals[0])
    turned = _stacked(_between(left, _entries(tangents[0]), right))
    one, other = jnp.stack(values)[:, None], jnp.stack(values)
    total = jnp.where(jnp.abs(one + other) < CONE, CONE, one + other)
    twist = (_log_sq_slope(one) + _log_sq_slope(other)) / total
    flip = _slope_difference(one, other)
    bent = (flip * (turned + turned.T) + twist * (turned - turned.T)) / 2
    energy, slope = _energy_of(left, values, right)
    change = _stacked(_outer(left, _entries(bent), right))
    return (energy, slope), (jnp.sum(slope * tangents[0]), change)


@jax.custom_jvp
def _strain_energy(strain):
    """¼ Σ log²(1 + μ) over the eigenvalues of JᵀJ - 1."""
    return _strain_energy_and_slope(strain)[0]


@_strain_energy.defjvp
def _strain_energy_jvp(primals, tangents):
    energy, slope = _strain_energy_and_slope(primals[0])
    return energy, jnp.sum(slope * tangents[0])


@jax.custom_jvp
def _strain_energy_and_slope(strain):
    return _strain_energy_of(*_eigen(strain))


def _strain_energy_of(values, basis):
    slope = _diagonal([jnp.log1p(value) / (2 * (1 + value)) for value in values])
    energy = sum(jnp.log1p(value) ** 2 for value in values) / 4
    return energy, _stacked(_outer(basis, slope, basis))


@_strain_energy_and_slope.defjvp
def _strain_energy_and_slope_jvp(primals, tangents):
    values, basis = _eigen(primals[0])
    turned = _stacked(_between(basis, _entries(tangents[0]), basis))
    both = jnp.stack(values)
    bent = turned * _log_quotient_difference(both[:, None], both) / 2
    energy, slope = _strain_energy_of(values, basis)
    change = _stacked(_outer(basis, _entries(bent), basis))
    return (energy, slope), (jnp.sum(slope * tangents[0]), change)


def _log(stretch):
    """log σ, and its tangent below `COLLAPSED`, through zero and beyond."""
    below = math.log(COLLAPSED) + (stretch - COLLAPSED) / COLLAPSED
    return jnp.where(
        stretch < COLLAPSED, below, jnp.log(jnp.maximum(stretch, COLLAPSED))
    )


def _log_sq_slope(stretch):
    """d(log²σ)/dσ of the continued logarithm."""
    return 2 * _log(stretch) / jnp.maximum(stretch, COLLAPSED)


def _slope_difference(one, other):
    """Divided difference of `_log_sq_slope`; its derivative where the two are equal.

    Split at `COLLAPSED`, on either side of which it is known without cancellation.
    """
    high, low = jnp.maximum(one, COLLAPSED), jnp.maximum(other, COLLAPSED)
    gap = one - other
    equal = gap == 0
    quotient = (high - low) / jnp.where(equal, 1, gap)
    share = jnp.where(equal, jnp.where(one < COLLAPSED, 0, 1), quotient)
    above = 2 * _log_quotient_difference(high - 1, low - 1)
    return share * above + (1 - share) * (2 / COLLAPSED**2)


def _log_quotient_difference(one, other):
    """Divided difference of log(1 + x) / (1 + x), without cancellation."""
    ratio = (one - other) / (1 + other)
    equal = ratio == 0
    quotient = jnp.where(equal, 1, jnp.log1p(ratio) / jnp.where(equal, 1, ratio))
    return (quotient - jnp.log1p(other)) / ((1 + one) * (1 + other))


def _oriented(signed, matrix):
    """U, σ, V; without sign, a negative σ3 goes into U, which then is a reflection."""
    left, values, right = _svd(matrix)
    if signed:
        return left, values, right
    mirror = jnp.where(values[2] < 0, -1, 1).astype(values[2].dtype)
    left = [*left[:2], tuple(mirror * x for x in left[2])]
    return left, (*values[:2], mirror * values[2]), right


@jax.custom_jvp
def _svd(matrix):
    """One-sided Jacobi (Hestenes 1958), in columns of scalars.

    It turns columns until they are orthogonal and never forms MᵀM, whose condition is
    squared: σ = 1e-3 keeps 3e-5 of itself in float32 where JᵀJ leaves a fifth.
    """
    # Squares of squares must stay in range. Outside, the matrix is zero or inf to any
    # purpose of this module, and `_log` takes it as that.
    largest = jnp.max(jnp.abs(matrix))
    usable = (largest > 1e-30) & (largest < 1e30)
    scale = jnp.where(usable, largest, 1)
    columns = [tuple(matrix[row, k] / scale for row in range(3)) for k in range(3)]
    one, zero = jnp.ones_like(scale), jnp.zeros_like(scale)
    right = [tuple(one if row == k else zero for row in range(3)) for k in range(3)]

    def sweep(_, both):
        columns, right, _ = map(list, both)
        for p, q in ((0, 1), (0, 2), (1, 2)):
            cosine, sine = _angle(
                _dot(columns[q], columns[q]) - _dot(columns[p], columns[p]),
                2 * _dot(columns[p], columns[q]),
            )
            _turn(columns, p, q, cosine, sine)
            _turn(right, p, q, cosine, sine)
        return columns, right, [_dot(column, column) for column in columns]

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


@_svd.defjvp
def _svd_jvp(primals, tangents):
    raise NotImplementedError(
        "singular vectors have no derivative where singular values are equal; use "
        "singular_values (once differentiable) or the energies (twice)"
    )


def _complete(columns):
    """Left vectors of orthogonal columns in falling order, also where some are zero."""
    first, second, third = columns
    one, zero = jnp.ones_like(first[0]), jnp.zeros_like(first[0])
    u1, length1 = _unit(first, (one, zero, zero))
    # Any direction across u1 will do for a column that is nothing but rounding.
    x, y, z = u1
    upright = jnp.abs(z) > 0.5
    across = (
        jnp.where(upright, z, y),
        jnp.where(upright, 0, -x),
        jnp.where(upright, -x, 0),
    )
    spare, _ = _unit(across, (zero, one, zero))
    along = _dot(u1, second)
    rest = tuple(s - along * u for s, u in zip(second, u1, strict=True))
    noise = 4 * jnp.finfo(one.dtype).eps * length1
    length2 = jnp.sqrt(_dot(rest, rest))
    lost = length2 <= noise
    u2, _ = _unit(
        tuple(jnp.where(lost, s, r) for s, r in zip(spare, rest, strict=True)), spare
    )
    u3 = (
        u1[1] * u2[2] - u1[2] * u2[1],
        u1[2] * u2[0] - u1[0] * u2[2],
        u1[0] * u2[1] - u1[1] * u2[0],
    )
    return [u1, u2, u3], (length1, length2, _dot(u3, third))


def _eigen(matrix):
    """Eigenvalues and columns of eigenvectors of a symmetric matrix, by Jacobi."""
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
    length = jnp.sqrt(_dot(vector, vector))
    none = length == 0
    divisor = jnp.where(none, 1, length)
    unit = (
        jnp.where(none, o, v / divisor) for o, v in zip(otherwise, vector, strict=True)
    )
    return tuple(unit), length


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _matrix(columns):
    return _stacked([[column[i] for column in columns] for i in range(3)])


# Products of rows of scalars: batched 3×3 `matmul`s are slower on a CPU, and on a GPU
# would round their factors to ten bits.


def _entries(matrix):
    return [[matrix[i, j] for j in range(3)] for i in range(3)]


def _stacked(rows):
    # In one piece: stacks of stacks take 25 times as long under `vmap` on XLA:CPU,
    # which then computes all nine entries anew for each of them.
    return jnp.stack([entry for row in rows for entry in row]).reshape(3, 3)


def _each(entry):
    return [[entry(i, j) for j in range(3)] for i in range(3)]


def _diagonal(values):
    zero = jnp.zeros_like(values[0])
    return _each(lambda i, j: values[i] if i == j else zero)


def _between(left, rows, right):
    """Uᵀ M V from columns of U and V."""
    moved = [[_dot(row, column) for column in right] for row in rows]  # M V
    return _each(lambda i, j: sum(left[i][k] * moved[k][j] for k in range(3)))


def _outer(left, rows, right):
    """U M Vᵀ from columns of U and V."""
    moved = _each(lambda i, j: sum(left[k][i] * rows[k][j] for k in range(3)))  # U M
    return _each(lambda i, j: sum(moved[i][k] * right[k][j] for k in range(3)))
