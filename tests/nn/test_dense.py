"""The product with one matrix against NumPy, and its slopes against plain products."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.nn import dense
from tests import gradients


def plain(inputs, weight):
    return inputs @ weight


@pytest.mark.parametrize("shape", [(3,), (0, 3), (5, 3), (2, 4, 3), (5, 0)])
def test_it_is_the_product_of_rows(shape, dtype, rng):
    inputs = rng.normal(size=shape).astype(dtype)
    weight = rng.normal(size=(shape[-1], 2)).astype(dtype)
    actual = dense.product(inputs, weight)
    assert actual.dtype == dtype
    np.testing.assert_allclose(
        actual, inputs @ weight, rtol={"float32": 1e-5, "float64": 1e-13}[dtype]
    )


@pytest.mark.parametrize("rows", [(4, 3), (64, 48), (64, 33), (53, 41)])
def test_slopes_under_vmaps_are_those_of_plain_products(rows, float64, rng):
    """In blocks of equal rows, at once where these do not come out even, and few."""
    assert (np.prod(rows) >= dense.LEAST_ROWS) == (rows != (4, 3))
    inputs = rng.normal(size=(*rows, 5))
    weight, toward = rng.normal(size=(5, 4)), rng.normal(size=4)

    def slopes(product):
        def value(inputs, weight):
            every = jax.vmap(jax.vmap(lambda x: jnp.sin(product(x, weight)) @ toward))
            return jnp.sum(every(inputs))

        return jax.jit(jax.grad(value, (0, 1)))(inputs, weight)

    for actual, expected in zip(slopes(dense.product), slopes(plain), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-12)


def test_a_matrix_for_each_example_and_slopes_of_slopes(float64, rng):
    """Gradients of an example of its own, of many matrices, and of a Jacobian."""
    inputs, weights = rng.normal(size=(6, 3)), rng.normal(size=(6, 3, 3))

    def strain(product, x, weight):
        jacobian = jax.jacfwd(lambda x: jnp.tanh(product(x, weight)))(x)
        return jnp.sum(jnp.square(jacobian.T @ jacobian))

    def each(product):
        both = jax.grad(lambda *a: strain(product, *a), (0, 1))
        shared = jax.vmap(both, (0, None))(inputs, weights[0])
        several = jax.vmap(both, (None, 0))(inputs[0], weights)
        return shared, several, jax.vmap(both)(inputs, weights)

    actual, expected = each(dense.product), each(plain)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, 1e-10), actual, expected)
    error = gradients.directional_error(
        lambda x, weight: strain(dense.product, x, weight), inputs[0], weights[0]
    )
    assert error < 1e-7


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"\(5, 4\).*\(3, 2\)"):
        jax.jit(dense.PRODUCT.bind)(jnp.ones((5, 4)), jnp.ones((3, 2)))
