"""Hard cases of the elastic energy: the logarithmic strain of a warp."""

import jax.numpy as jnp
import mpmath
import numpy as np

from experiments.hard_cases.case import Case, constant
from nerfies_jax.geometry import matrix3

# Three directions in which a matrix moves, in numbers that every precision holds: a
# stretch with a turn, a shear, and a stretch along other axes.
DIRECTIONS = np.array(
    [
        [[1, -2, 0.5], [1.5, -0.5, 0], [0, 1, 0.5]],
        [[0, 1, 2], [0, 0.5, -1], [0, 0, -1]],
        [[0.5, 0.5, -1], [0.5, 1, 0], [-1, 0, -1.5]],
    ]
)
ALONG = np.array([1.0, -0.5, 0.25])


def _positions(shares):
    """[3, 3] the sum of directions, each so far."""
    directions = constant(DIRECTIONS, shares.dtype)
    return jnp.sum(shares[:, None, None] * directions, axis=0)


def _exact_moved(shares):
    total = mpmath.zeros(3)
    for share, direction in zip(shares, DIRECTIONS, strict=True):
        total += share * mpmath.matrix(direction.tolist())
    return total


def _squared_singular(matrix):
    """Compute eigenvalues of JᵀJ by its cubic, which loses half the digits of close
    pairs.
    """
    a = matrix.T * matrix
    mean = (a[0, 0] + a[1, 1] + a[2, 2]) / 3
    b = a - mean * mpmath.eye(3)
    size = mpmath.sqrt(sum(x**2 for x in b) / 6)
    if size == 0:
        return [mean] * 3
    angle = mpmath.acos(mpmath.det(b) / (2 * size**3)) / 3
    third = 2 * mpmath.pi / 3
    return [mean + 2 * size * mpmath.cos(angle + k * third) for k in range(3)]


def _exact_energy(matrix):
    return [sum(mpmath.log(x) ** 2 for x in _squared_singular(matrix)) / 4]


def _exact_log(stretch):
    """log, and its tangent below a hundredth."""
    edge = mpmath.mpf(matrix3.COLLAPSED)
    if stretch >= edge:
        return mpmath.log(stretch)
    return mpmath.log(edge) + (stretch - edge) / edge


def _by_svd(matrix):
    """Σ log²σ as in the official Nerfies code."""
    values = jnp.linalg.svd(matrix, compute_uv=False)
    return jnp.sum(jnp.log(jnp.maximum(values, 1e-6)) ** 2)


def _by_squares(matrix):
    """Σ log²σ from the eigenvalues of JᵀJ, half the cost in textbooks."""
    return jnp.sum(jnp.log(jnp.linalg.eigvalsh(matrix.T @ matrix)) ** 2) / 4


def _of_displacement(form):
    return lambda shares: form(_positions(shares))[None]


def _of_jacobian(form, size=1.0):
    """Evaluate at a perturbed multiple of the identity."""

    def energy(shares):
        return form(size * jnp.eye(3, dtype=shares.dtype) + _positions(shares))[None]

    return energy


_EDGE = matrix3.SMALL_DISPLACEMENT / np.linalg.norm(np.tensordot(ALONG, DIRECTIONS, 1))
_STRAINS = np.array(
    [0, 1e-15, 1e-12, 1e-8, 1e-5, 1e-3, *(_EDGE * (1 + np.array([-1e-6, 1e-6]))), 0.2]
)
SMALL_STRAIN = Case(
    name="strain of a small displacement",
    breaks="J = 1 + D rounds D away. 1e-8 is lost entirely in float32.",
    formula="log1p of the eigenvalues of D + Dᵀ + DᵀD is used",
    switch=f"switch at |D| = {matrix3.SMALL_DISPLACEMENT:g}",
    axis="share of D",
    at=_STRAINS,
    along=ALONG,
    stable=_of_displacement(matrix3.displacement_log_energy),
    textbook=_of_jacobian(_by_svd),
    exact=lambda shares: _exact_energy(mpmath.eye(3) + _exact_moved(shares)),
    bounds={"float32": (1e-5, 1e-5, 2e-6), "float64": (2e-14, 1e-14, 4e-15)},
    floors=(0, 1e-25, 0),
    timed=0.01 * ALONG,
)

# Exact in float32, so that J is what was asked for.
_EQUAL = np.array([0, 2.0**-12, 2.0**-9, 2.0**-6, 2.0**-3, 2.0**-1])
EQUAL_VALUES = Case(
    name="equal singular values",
    breaks="Second derivatives of LAPACK's SVD are NaN where two are equal.",
    formula="Divided differences are computed by log1p(x)/x",
    axis="share of D about 2",
    at=_EQUAL,
    along=ALONG,
    stable=_of_jacobian(matrix3.log_energy, 2.0),
    textbook=_of_jacobian(_by_svd, 2.0),
    exact=lambda shares: _exact_energy(2 * mpmath.eye(3) + _exact_moved(shares)),
    bounds={"float32": (2e-6, 2e-6, 1e-6), "float64": (4e-15, 4e-15, 4e-15)},
    timed=0.25 * ALONG,
)

# Rotations off the axes, times three.
_TURN = np.array([[2, -1, 2], [2, 2, -1], [-1, 2, 2]])
_BACK = np.array([[-1, 2, 2], [-2, 1, -2], [-2, -2, 1]])


def _matrix_of_stretches(stretches):
    """[3, 3] U diag(stretches) Vᵀ."""
    left, right = (constant(turn, stretches.dtype) for turn in (_TURN, _BACK))
    return jnp.sum(left[:, None] * stretches * right, axis=-1) / 9


def _exact_stretched(stretches):
    return [sum(_exact_log(stretch) ** 2 for stretch in stretches)]


def _of_stretches(form):
    return lambda stretches: form(_matrix_of_stretches(stretches))[None]


_LEAST = np.array([1e-5, 1e-4, 1e-3, 9.99e-3, 1.001e-2, 2e-2, 0.1, 0.5])
COLLAPSE = Case(
    name="a direction that collapses",
    breaks="JᵀJ loses singular values below 3e-4. log 0 is infinite, and a clamp has "
    "no gradient.",
    formula="One-sided Jacobi rotations are applied to J itself, and the logarithm "
    "is continued by its tangent",
    switch=f"switch at a singular value of {matrix3.COLLAPSED:g}",
    axis="least stretch",
    at=_LEAST,
    points=np.stack([np.full(8, 1.5), np.full(8, 0.75), _LEAST], axis=1),
    stable=_of_stretches(matrix3.log_energy),
    textbook=_of_stretches(_by_squares),
    exact=_exact_stretched,
    bounds={"float32": (1e-5, 1e-5, 1e-5), "float64": (2e-14, 2e-14, 7e-14)},
    timed=np.array([1.5, 0.75, 0.5]),
)

_THROUGH = np.array([-2, -1, -0.1, -1e-2, -1e-3, 0, 1e-3, 1e-2 * (1 - 1e-6), 0.1, 0.5])
FOLD = Case(
    name="a fold, through the collapse",
    breaks="Reflections have no energy, and log 0 lies between them and the identity.",
    formula="The smallest singular value has the sign of the determinant, and the "
    "logarithm is continued by its tangent",
    switch=f"switch at a singular value of {matrix3.COLLAPSED:g}",
    axis="least stretch, signed",
    at=_THROUGH,
    points=np.stack([np.full(10, 3.0), np.full(10, 2.5), _THROUGH], axis=1),
    stable=_of_stretches(matrix3.signed_log_energy),
    textbook=_of_stretches(_by_svd),
    exact=_exact_stretched,
    bounds={"float32": (1e-5, 1e-5, 1e-5), "float64": (2e-14, 2e-14, 4e-14)},
    timed=np.array([1.5, 0.75, 0.5]),
)

CASES = (SMALL_STRAIN, EQUAL_VALUES, COLLAPSE, FOLD)
