"""The elastic energy of a warp, against SciPy's singular values of a known Jacobian."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.spatial.transform

from nerfies_jax.fields.effects.elastic_loss import elastic_loss
from tests import gradients

MATRIX = np.array([[1.1, 0.2, -0.1], [0.05, 0.9, 0.3], [-0.2, 0.1, 1.2]])
TURN = scipy.spatial.transform.Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()


def bend(matrix):
    """A warp whose Jacobian is known at every point."""
    return lambda x: matrix @ x + jnp.sin(x) / 10


def exact(matrix, points):
    """The energy of `bend` at each point, by SciPy."""
    jacobians = matrix + np.cos(points)[..., None, :] * np.eye(3) / 10
    values = np.array(
        [scipy.linalg.svdvals(one) for one in jacobians.reshape(-1, 3, 3)]
    )
    return np.sum(np.log(values) ** 2, axis=-1)


def test_it_is_the_mean_energy_of_the_warp_itself(dtype, rng):
    points = rng.normal(size=(2, 5, 3))
    energies = exact(MATRIX, points)
    weights = rng.uniform(size=(2, 5))
    robust = 2 * energies / (energies + 4 * 0.03**2)
    matrix, inputs = jnp.asarray(MATRIX, dtype), jnp.asarray(points, dtype)
    plain, weighted, robustly = jax.jit(
        lambda: (
            elastic_loss(bend(matrix), inputs),
            elastic_loss(bend(matrix), inputs, jnp.asarray(weights, dtype)),
            elastic_loss(bend(matrix), inputs, robust_width=0.03),
        )
    )()
    bound = {"float32": 2e-6, "float64": 1e-13}[dtype]
    assert plain.dtype == dtype
    assert abs(plain / energies.mean() - 1) < bound
    mean = np.sum(weights.ravel() * energies) / weights.sum()
    assert abs(weighted / mean - 1) < bound
    assert abs(robustly / robust.mean() - 1) < bound


@pytest.mark.parametrize(
    ("matrix", "energy"),
    [
        (TURN, 0.0),
        (np.eye(3), 0.0),
        (np.diag([1, 1, -1.0]), 0.0),  # a mirror image is free without `fold_cost`
        (TURN * 1.001, 3 * np.log(1.001) ** 2),
    ],
    ids=["a rotation", "rest", "a mirror", "a small stretch"],
)
def test_rigid_warps_cost_nothing_and_small_strains_keep_their_digits(
    matrix, energy, dtype
):
    linear = jnp.asarray(matrix, dtype)

    def loss(linear):
        return elastic_loss(lambda x: linear @ x, jnp.ones((2, 3), dtype))

    value, grad = jax.jit(jax.value_and_grad(loss))(linear)
    # The Jacobian is rounded to 6e-8 and 1e-16: strains below are not resolved.
    assert abs(value - energy) < {"float32": 1e-9, "float64": 1e-17}[dtype]
    assert np.isfinite(grad).all()


def test_a_fold_costs_what_is_asked_for():
    mirror = jnp.diag(jnp.asarray([1, 1, -1.0]))
    points = jnp.ones((2, 3))
    folded = jax.jit(
        lambda: elastic_loss(lambda x: mirror @ x, points, fold_cost=0.5)
    )()
    assert folded > 0.5


@pytest.mark.full
def test_gradients_are_those_of_central_differences(float64, rng):
    points = rng.normal(size=(4, 3))

    def loss(matrix, points):
        return elastic_loss(bend(matrix), points, robust_width=0.3, fold_cost=1.0)

    assert gradients.directional_error(loss, MATRIX, points) < 1e-7


def test_what_is_no_warp_of_points_is_refused():
    points = jnp.ones((4, 3))
    with pytest.raises(ValueError, match=r"`warp` returns \[\] for one point"):
        elastic_loss(jnp.sum, points)
    with pytest.raises(ValueError, match=r"`points` has shape \[4, 2\]"):
        elastic_loss(lambda x: x, jnp.ones((4, 2)))
    with pytest.raises(ValueError, match=r"`weights` has shape \[3\]"):
        elastic_loss(lambda x: x, points, jnp.ones(3))
    with pytest.raises(ValueError, match="bfloat16, which resolve no strain below"):
        elastic_loss(lambda x: x, points.astype(jnp.bfloat16))
