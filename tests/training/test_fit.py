"""Codes fitted by every solver, and flags where a fit has not converged."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.training.fit import CODE_SOLVERS, fit_code

FIRST, *OTHERS = CODE_SOLVERS
ONE_SOLVER = [FIRST, *(pytest.param(name, marks=pytest.mark.full) for name in OTHERS)]
# Steps and tolerance at which each solver has surely arrived. Adam only creeps there.
GENEROUS = {name: (200, 1e-3) for name in CODE_SOLVERS} | {"adam": (1000, 1e-2)}


@pytest.mark.parametrize("solver", ONE_SOLVER)
def test_every_solver_finds_the_ridge_regression(solver, dtype, rng):
    """Against the normal equations, for a code of two arrays."""
    matrix = rng.normal(size=(30, 8))
    wanted = matrix @ rng.normal(size=8) * 0.3
    exact = np.linalg.solve(matrix.T @ matrix + 0.1 * np.eye(8), matrix.T @ wanted)
    rows, target = matrix.astype(dtype), wanted.astype(dtype)

    def loss(code):
        flat = jnp.concatenate([code["a"], code["b"].reshape(-1)])
        return jnp.sum((rows @ flat - target) ** 2) + 0.1 * jnp.sum(flat**2)

    start = {"a": np.zeros(2, dtype), "b": np.zeros((2, 3), dtype)}
    steps, tolerance = GENEROUS[solver]
    solved = jax.jit(lambda start: fit_code(loss, start, solver, steps, tolerance))(
        start
    )
    assert solved.converged
    assert 1 < solved.steps <= steps
    assert solved.residual <= tolerance
    assert solved.value["b"].shape == (2, 3)
    code = np.concatenate([solved.value["a"], np.ravel(solved.value["b"])])
    # the gradient is the Hessian times the distance
    curvature = 2 * np.linalg.eigvalsh(matrix.T @ matrix + 0.1 * np.eye(8))[0]
    assert np.linalg.norm(code - exact) < tolerance / curvature + 1e-6


@pytest.mark.parametrize("solver", ONE_SOLVER)
def test_a_bad_start_comes_back_flagged(solver, dtype):
    start = np.asarray([-1.0, 2.0], dtype)
    solved = jax.jit(
        lambda start: fit_code(lambda c: jnp.sum(jnp.log(c)), start, solver, 20)
    )(start)
    assert not solved.converged
    np.testing.assert_array_equal(solved.value, start)


@pytest.mark.full
@pytest.mark.parametrize("solver", CODE_SOLVERS)
def test_a_solve_cut_short_is_flagged_and_no_worse_than_its_start(solver):
    """The loss is finite only left of 1, close to where the descent leads."""

    def loss(code):
        return jnp.sum(-jnp.log(1 - code) - 300 * code)

    start = np.float32([0.5, -3.0])
    value = jax.jit(loss)
    solved = jax.jit(lambda start: fit_code(loss, start, solver, 3, 1e-6))(start)
    assert not solved.converged
    assert np.isfinite(solved.value).all()
    assert value(solved.value) <= value(start)


@pytest.mark.parametrize("solver", CODE_SOLVERS)
@pytest.mark.full
def test_float32_codes_stay_float32_with_x64_on(solver, float64):
    solved = jax.jit(
        lambda start: fit_code(lambda c: jnp.sum((c - 0.5) ** 2), start, solver, 300)
    )(np.zeros(3, np.float32))
    assert solved.value.dtype == solved.residual.dtype == jnp.float32
    assert solved.converged
    np.testing.assert_allclose(solved.value, 0.5, atol=1e-3)
