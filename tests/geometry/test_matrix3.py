"""Elastic energies against NumPy's and mpmath's decompositions."""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.spatial.transform

from nerfies_jax.geometry import matrix3
from tests import gradients

Rotation = scipy.spatial.transform.Rotation
ENERGIES = {False: matrix3.log_energy, True: matrix3.signed_log_energy}


@jax.jit
@jax.vmap
def decomposed(matrix):
    """U, σ, V, and singular values by themselves."""
    return matrix3.svd(matrix), matrix3.singular_values(matrix)


def all_orders(function, matrix, direction):
    """Value, slope, and Hessian times a direction."""
    pair = jax.value_and_grad(function)
    (value, grad), (_, bent) = jax.jvp(pair, (matrix,), (direction,))
    return value, grad, bent


@jax.jit
@jax.vmap
def energies(matrix, direction):
    """`all_orders` without and with the sign."""
    return [all_orders(ENERGIES[s], matrix, direction) for s in (False, True)]


def of_some(function, matrices, direction=None):
    """The results for some matrices, by the program compiled for 100 of them."""
    inputs = np.resize(matrices, (100, 3, 3))
    ways = (
        np.zeros_like(inputs)
        if direction is None
        else np.resize(direction, (100, 3, 3))
    )
    results = jax.tree.map(np.asarray, function(inputs, ways.astype(inputs.dtype)))
    return jax.tree.map(lambda leaf: leaf[: len(matrices)], results)


def exact(matrix, signed):
    """Energy and gradient from NumPy's SVD in float64, one value at a time."""
    left, values, right = np.linalg.svd(np.asarray(matrix, np.float64))
    if signed and np.linalg.det(left) * np.linalg.det(right) < 0:
        left, values = left * [1, 1, -1], values * [1, 1, -1]
    total, gradient = 0.0, np.zeros((3, 3))
    for k, value in enumerate(values):
        if value >= 0.01:
            log, rate = np.log(value), 1 / value
        else:
            log, rate = np.log(0.01) + (value - 0.01) / 0.01, 100
        total += log**2
        gradient += 2 * log * rate * np.outer(left[:, k], right[k])
    return total, gradient


def matrices(rng):
    """Near rigid, moderate, wild, thin and mirrored; 20 each."""
    samples = rng.normal(size=(5, 20, 3, 3))
    samples[0] = np.eye(3) + 1e-2 * samples[0]
    samples[1] = np.eye(3) + 0.3 * samples[1]
    samples[3] = samples[3] @ np.diag([1, 1, 1e-1])
    samples[4] = -(np.abs(np.linalg.det(samples[4]))[:, None, None] ** -1) * samples[4]
    return samples.reshape(-1, 3, 3)


@pytest.mark.hard_cases
@pytest.mark.parametrize("size", [1e-25, 1e-10, 1.0, 1e15, 1e25])
def test_decomposition_restores_the_matrix(size, dtype, rng):
    inputs = (size * matrices(rng)).astype(dtype)
    vectors, singular_values = decomposed(inputs)
    left, values, right = (np.asarray(x, np.float64) for x in vectors)
    restored = (left * values[:, None]) @ np.swapaxes(right, 1, 2)
    scale = np.abs(np.asarray(inputs, np.float64)).max(axis=(1, 2))
    bound = {"float32": 2e-6, "float64": 5e-15}[dtype]
    assert np.max(np.abs(restored - inputs).max(axis=(1, 2)) / scale) < bound
    truth = np.linalg.svd(np.asarray(inputs, np.float64))[1]
    assert np.max(np.abs(np.abs(values) - truth) / scale[:, None]) < bound
    assert np.min(np.linalg.det(left)) > 0.99
    assert np.min(np.linalg.det(right)) > 0.99
    assert np.array_equal(np.sign(values[:, 2]), np.sign(np.linalg.det(inputs / size)))
    np.testing.assert_allclose(singular_values, np.abs(values), rtol=1e-6)


@pytest.mark.hard_cases
def test_many_nearly_rigid_matrices_are_decomposed_at_once(dtype, rng):
    """Which column is the longer one is then a matter of rounding."""
    turns = Rotation.random(100, random_state=0).as_matrix()
    ulps = np.repeat([0, 4, 100, 1e4], 25)[:, None, None]
    strain = ulps * np.finfo(dtype).eps * rng.normal(size=(100, 3, 3))
    inputs = (turns @ (np.eye(3) + strain)).astype(dtype)
    (left, values, right), singular_values = jax.tree.map(
        np.asarray, decomposed(inputs)
    )
    restored = (left * values[:, None]) @ np.swapaxes(right, 1, 2)
    bound = {"float32": 2e-6, "float64": 1e-14}[dtype]
    assert np.max(np.abs(restored - inputs)) < bound
    truth = np.linalg.svd(inputs.astype(np.float64))[1]
    assert np.max(np.abs(singular_values - truth)) < bound


@pytest.mark.parametrize("signed", [False, True])
def test_energy_and_gradient(signed, dtype, rng):
    inputs = matrices(rng).astype(dtype)
    truth = [exact(matrix, signed) for matrix in inputs]
    values = np.array([value for value, _ in truth])
    grads = np.array([gradient for _, gradient in truth])
    # relative to the conditioning: an ulp of the matrix moves σ by as much
    bound = {"float32": 2e-5, "float64": 1e-13}[dtype]
    energy, grad, _ = of_some(energies, inputs)[signed]
    np.testing.assert_allclose(energy, values, rtol=bound, atol=bound)
    error = np.abs(grad - grads).max(axis=(1, 2))
    conditions = np.linalg.cond(np.asarray(inputs, np.float64))
    assert np.max(error / (1 + np.abs(grads).max(axis=(1, 2)) * conditions)) < bound


@pytest.mark.parametrize(
    "name",
    [
        "energy",
        pytest.param("signed", marks=pytest.mark.slow),
        pytest.param("displacement", marks=pytest.mark.slow),
    ],
)
def test_slopes_and_curvature_are_those_of_differences(name, float64, rng):
    shapes = [matrices(rng)[30], np.diag([1.3, 0.5, 4e-3]), np.diag([2, 1, -0.5])]
    points = np.array([np.linalg.qr(rng.normal(size=(3, 3)))[0] @ m for m in shapes])
    function, step = ENERGIES[name == "signed"], 1e-5
    if name == "displacement":
        function, step = matrix3.displacement_log_energy, 1e-6
        points = np.array([[[1e-2]], [[0.5]], [[0.1]]]) * rng.normal(size=points.shape)
    slopes_at = jax.vmap(jax.grad(function))
    # slopes of folded matrices are ten thousand times others'
    size = np.abs(jax.jit(slopes_at)(points)).max((1, 2), keepdims=True)
    weight = jnp.asarray(rng.normal(size=points.shape) / size)

    def total(points):
        return jnp.sum(jax.vmap(function)(points) / jnp.asarray(size[:, 0, 0]))

    def along(points):
        return jnp.sum(slopes_at(points) * weight)

    assert gradients.directional_error(total, points, step=step) < 1e-6
    assert gradients.directional_error(along, points, step=step) < 1e-6


def test_slopes_of_singular_values_are_those_of_differences(float64, rng):
    def total(matrix):
        return matrix3.singular_values(matrix) @ jnp.asarray([1.0, -0.5, 2.0])

    assert gradients.directional_error(total, matrices(rng)[30]) < 1e-6


HARD = {
    "identity": np.eye(3),
    "rotation": np.asarray([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]),
    "two equal": np.diag([2, 2, 0.5]),
    "three equal": 2 * np.eye(3),
    "zero": np.zeros((3, 3)),
    "rank one": np.outer([1, 2, 3], [0.5, -1, 0.2]),
    "rank two": np.diag([1.0, 2, 0]),
    "denormal": 1e-40 * np.eye(3),
    "tiny": 1e-20 * np.eye(3),
    "huge": 1e15 * np.eye(3),
    "collapsing": np.diag([1, 1, 1e-5]),
    "mirror": np.diag([1, 1, -1.0]),
    "flat": np.diag([1, 1, 0.0]),
    "at the switch": np.diag([1, 0.01, 0.01]),
    "nearly equal": np.diag([1, 1 + 1e-7, 1 - 1e-7]),
}


DIRECTION = np.random.default_rng(0).normal(size=(3, 3))


@functools.cache
def hard_energies(dtype):
    """By sign and name: value, slope, and Hessian times `DIRECTION`."""
    inputs = np.asarray(list(HARD.values()), dtype)
    results = of_some(energies, inputs, DIRECTION)
    return {
        signed: dict(zip(HARD, zip(*results[signed], strict=True), strict=True))
        for signed in (False, True)
    }


@pytest.mark.hard_cases
@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("name", HARD)
def test_hard_matrices_have_finite_energy_slope_and_curvature(name, signed, dtype):
    value, _ = exact(HARD[name].astype(dtype), signed)
    energy, gradient, bent = hard_energies(dtype)[signed][name]
    np.testing.assert_allclose(energy, value, rtol=2e-6, atol=1e-12)
    assert np.all(np.isfinite(gradient))
    assert np.all(np.isfinite(bent))
    if name in {"zero", "rank one", "rank two", "tiny", "collapsing"}:
        assert np.max(abs(gradient)) > 100  # not the zero slope of a clamp


STRETCHED = [
    *([size, 0.02, 0.018] for size in (1e3, 5e4, 1e6, 1e20)),
    *([1e5, 1, 0.9], [1e5, 1, -0.9], [1e6, 1, -0.9], [1e30, 0.02, 0.018]),
    [1e-30, 8e-31, 6e-31],
]
SIDES = [(0, 1), (0, 2), (1, 2)]


@pytest.mark.hard_cases
@pytest.mark.parametrize("signed", [False, True])
def test_stretches_far_apart_keep_their_slopes_and_curvature(signed, dtype):
    """The closed form of a diagonal matrix, sheared alike in both directions.

    log1p from the larger stretch down flips the sign of a curvature at a ratio of 5e6
    and is NaN at 5e7; a second stretch taken for rounding flips that of a slope.
    """
    samples = np.asarray(STRETCHED, dtype)
    samples = samples if signed else abs(samples)
    cases = [(stretches, i, j) for stretches in samples for i, j in SIDES]
    ways = np.zeros((len(cases), 3, 3), dtype)
    for way, (_, i, j) in zip(ways, cases, strict=True):
        way[i, j] = way[j, i] = 1
    inputs = np.stack([np.diag(stretches) for stretches, _, _ in cases])
    _, grads, bent = of_some(energies, inputs, ways)[signed]
    # below 1e-37 float32 is flushed to zero
    close = {"rtol": {"float32": 2e-6, "float64": 1e-14}[dtype], "atol": 1e-37}
    for (stretches, i, j), grad, bend in zip(cases, grads, bent, strict=True):
        with mpmath.workdps(60):
            exact = [mpmath.mpf(float(s)) for s in stretches]
            rate = [_mp_slope(s) for s in exact]
            change = float((rate[i] - rate[j]) / (exact[i] - exact[j]))
        np.testing.assert_allclose(np.diag(grad), [float(r) for r in rate], **close)
        np.testing.assert_allclose([bend[i, j], bend[j, i]], [change] * 2, **close)


def _mp_slope(stretch):
    """d(log² σ)/dσ, its logarithm straight below a hundredth."""
    edge = mpmath.mpf(matrix3.COLLAPSED)
    below = mpmath.log(edge) + (stretch - edge) / edge
    logarithm = below if stretch < edge else mpmath.log(stretch)
    return 2 * logarithm / max(stretch, edge)


def test_singular_vectors_refuse_to_be_differentiated():
    with pytest.raises(NotImplementedError, match="singular_values"):
        jax.jacfwd(lambda m: matrix3.svd(m)[0])(jnp.eye(3))
