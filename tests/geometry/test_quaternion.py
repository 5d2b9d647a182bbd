"""Quaternions against SciPy's rotations, at every length and angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform

from nerfies_jax.geometry import quaternion
from tests import gradients

Rotation = scipy.spatial.transform.Rotation
TOLERANCE = {"float32": 5e-7, "float64": 1e-15}

to_matrix = jax.jit(jax.vmap(quaternion.to_matrix))
from_matrix = jax.jit(jax.vmap(quaternion.from_matrix))
slerp = jax.jit(jax.vmap(quaternion.slerp))


@jax.jit
@jax.vmap
def composed(second, first, vector):
    """The product, its own undoing, and a vector turned by the first."""
    product = quaternion.multiply(second, first)
    undone = quaternion.multiply(product, quaternion.conjugate(product))
    return product, undone, quaternion.rotate(first, vector)


@jax.jit
def normalized(q):
    """And its slope."""
    return quaternion.normalize(q), jax.jacrev(quaternion.normalize)(q)


@jax.jit
@jax.vmap
def round_trip(w):
    """The exponential, logarithms of it and of its negative, slope of the first."""
    unit = quaternion.exp(w)
    grad = jax.jacfwd(lambda w: quaternion.log(quaternion.exp(w)))
    return unit, quaternion.log(unit), quaternion.log(-unit), grad(w)


def random_quaternions(rng, count=50):
    """Random unit quaternions, wxyz, with w of both signs."""
    values = rng.normal(size=(count, 4))
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def scipy_of(wxyz):
    return Rotation.from_quat(np.roll(np.asarray(wxyz, np.float64), -1, axis=-1))


def test_matrices_products_and_rotated_vectors_match_scipy(dtype, rng):
    second, first, vectors = (
        random_quaternions(rng),
        random_quaternions(rng),
        rng.normal(size=(50, 3)),
    )
    inputs = (np.asarray(x, dtype) for x in (second, first, vectors))
    product, undone, rotated = composed(*inputs)
    truth = (scipy_of(second) * scipy_of(first)).as_matrix()
    assert np.max(abs(np.asarray(to_matrix(product)) - truth)) < 2 * TOLERANCE[dtype]
    assert np.max(abs(np.asarray(undone) - np.eye(4)[0])) < 2 * TOLERANCE[dtype]
    turned = scipy_of(first).apply(vectors)
    assert np.max(abs(np.asarray(rotated) - turned)) < 6 * TOLERANCE[dtype]


@pytest.mark.hard_cases
@pytest.mark.parametrize("length", [0, 1e-38, 1e-30, 1e-19, 1e25, 3e38, np.inf])
def test_normalizing_never_makes_what_is_no_rotation(length, dtype):
    inputs = np.asarray(length * np.array([0.5, -0.5, 0.1, 0.7]), dtype)
    unit, grad = (np.asarray(leaf) for leaf in normalized(inputs))
    assert abs(np.linalg.norm(unit) - 1) < 1e-6
    assert np.all(np.isfinite(grad))
    if length in (0, np.inf):
        assert np.array_equal(unit, [1, 0, 0, 0])
        assert np.all(grad == 0)


@pytest.mark.hard_cases
def test_normalizing_does_not_hide_nan():
    assert np.isnan(normalized(np.float32([np.nan, 0, 0, 1]))[0]).any()


@pytest.mark.hard_cases
@pytest.mark.parametrize("angle", [0, 1e-8, 1e-3, 1.0, 3.0, np.pi - 1e-6, np.pi])
def test_matrix_to_quaternion_at_every_pivot(angle, dtype, rng):
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(20, 3))])
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    truth = Rotation.from_rotvec(angle * axes)
    quaternions = np.asarray(from_matrix(np.asarray(truth.as_matrix(), dtype)))
    assert np.all(quaternions[:, 0] >= 0)
    error = (scipy_of(quaternions).inv() * truth).magnitude()
    assert error.max() < {"float32": 6e-7, "float64": 2e-15}[dtype]


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    "angle",
    [0, 1e-30, 1e-20, 1e-8, 1e-4, 0.39, 0.41, 1.0, 3.0, np.pi - 1e-5, np.pi - 1e-6],
)
def test_log_inverts_exp_below_pi_for_both_signs(angle, dtype, rng):
    axes = rng.normal(size=(20, 3))
    vectors = np.asarray(angle * axes / np.linalg.norm(axes, axis=-1)[:, None], dtype)
    unit, *logs, grads = (np.asarray(log) for log in round_trip(vectors))
    truth = np.roll(
        Rotation.from_rotvec(np.array(vectors, np.float64)).as_quat(), 1, axis=-1
    )
    assert np.max(abs(unit - truth)) < TOLERANCE[dtype]
    # float32 keeps the angle near π through w = 5e-7, hence to an ulp of the sine: 1e-7
    bound = {"float32": 1e-6, "float64": 2e-15}[dtype] * max(angle, 1e-8)
    for log in logs:
        assert np.max(abs(log - vectors)) < bound
    assert np.max(abs(grads - np.eye(3))) < {"float32": 1e-6, "float64": 2e-15}[dtype]


def test_slerp_matches_scipy(dtype, rng):
    ends = random_quaternions(rng, 2)
    line = scipy.spatial.transform.Slerp([0, 1], scipy_of(ends))
    shares = np.repeat([0.0, 0.2, 0.7, 1.0], 2)
    start, end = (np.tile(x, (8, 1)).astype(dtype) for x in ends)
    end[1::2] *= -1
    between = slerp(start, end, shares.astype(dtype))
    error = (scipy_of(between).inv() * line(shares)).magnitude()
    assert error.max() < {"float32": 1e-6, "float64": 3e-15}[dtype]


@pytest.mark.full
def test_gradients(float64, rng):
    one, other = random_quaternions(rng, 2)
    weight, vector = (jnp.asarray(rng.normal(size=size)) for size in ((3, 3), 3))

    def everything(one, other):
        matrix = quaternion.to_matrix(
            quaternion.slerp(one, 1.5 * other, jnp.asarray(0.3))
        )
        back = quaternion.log(quaternion.from_matrix(matrix))
        turned = quaternion.rotate(one, vector)
        return jnp.sum(matrix * weight) + back @ weight[0] + turned @ weight[1]

    # slerp holds for unit quaternions only: stay on the sphere
    def on_sphere(one, other):
        return everything(quaternion.normalize(one), quaternion.normalize(other))

    assert gradients.directional_error(on_sphere, one, other) < 1e-7
