"""`linear_call` against the same function left to JAX, under every transformation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.geometry.linear_call import linear_call


def product(power, residuals, argument):
    """Scaled by powers of a residual, so that derivatives with respect to it exist."""
    return residuals["scale"] ** power * (residuals["matrix"] @ argument)


def transposed(power, residuals, argument):
    return residuals["scale"] ** power * (residuals["matrix"].T @ argument)


def wrong(power, residuals, argument):
    return jnp.full_like(residuals["matrix"][0], 7) * argument[0]


def call(scale, matrix, argument, transpose=transposed):
    residuals = {"matrix": matrix, "scale": scale, "rank": jnp.int32(2)}
    return linear_call(product, transpose, 3, residuals, argument)


def plain(scale, matrix, argument):
    return product(3, {"matrix": matrix, "scale": scale}, argument)


def loss(function):
    return lambda *args: jnp.sum(jnp.sin(function(*args)))


def hessian_product(function, *args):
    """Forward over reverse: what is linear in reverse has residuals that move."""
    scale, matrix, argument = args

    def gradient(scale, argument):
        return jax.grad(lambda x: loss(function)(scale, matrix, x))(argument)

    tangents = jnp.ones_like(scale), jnp.cos(argument)
    return jax.jvp(gradient, (scale, argument), tangents)


def over_cameras(function, axes):
    return lambda *args: jax.vmap(
        lambda *one: jax.value_and_grad(loss(function), 2)(*one), axes
    )(*args)


def nested(function, scale, matrix, argument):
    """Two axes, of which residual and argument have one each."""
    inner = jax.vmap(jax.grad(loss(function), 2), (None, None, 0))
    return jax.vmap(inner, (None, 0, None))(scale, matrix, argument)


SHAPES = {"one": ((), (4, 3), (3,)), "all": ((2,), (2, 4, 3), (2, 3))}
TRANSFORMED = {
    "value": (lambda f: f, "one"),
    "forward": (lambda f: lambda *x: jax.jvp(f, x, jax.tree.map(jnp.sin, x)), "one"),
    "reverse": (lambda f: jax.grad(loss(f), 2), "one"),
    "forward over reverse": (lambda f: lambda *x: hessian_product(f, *x), "one"),
    "batch": (lambda f: over_cameras(f, 0), "all"),
    "batch of residuals": (lambda f: over_cameras(f, (0, 0, None)), "all"),
    "batch of arguments": (lambda f: over_cameras(f, (None, None, 0)), "all"),
    "two batches": (lambda f: lambda *x: nested(f, *x), "all"),
}


@pytest.mark.parametrize("name", TRANSFORMED)
def test_transformed_calls_equal_the_plain_function(name, float64, rng):
    transform, shapes = TRANSFORMED[name]
    args = [rng.normal(size=shape) for shape in SHAPES[shapes]]
    if name == "batch of residuals":
        args[2] = args[2][0]
    if name == "batch of arguments":
        args[:2] = [x[0] for x in args[:2]]
    if name == "two batches":
        args[0] = args[0][0]
    result = jax.jit(transform(call))(*args)
    expected = jax.jit(transform(plain))(*args)
    for one, other in zip(
        jax.tree.leaves(result), jax.tree.leaves(expected), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_reverse_mode_uses_the_given_transpose(float64, rng):
    scale, matrix, argument = (rng.normal(size=shape) for shape in SHAPES["one"])

    def first(x):
        return call(scale, matrix, x, wrong)[0]

    np.testing.assert_array_equal(jax.grad(first)(argument), np.full(3, 7.0))
