"""Arrays that XLA:CPU shall compute before they are read, against plain indexing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.geometry import fusion
from tests import gradients


def turned(parts):
    x, y, z = parts
    return [x * y - jnp.sin(z), z * x, y * jnp.exp(x)]


def ours(vector):
    return fusion.stacked(turned(fusion.components(vector)))


def plain(vector):
    return jnp.stack(turned([vector[0], vector[1], vector[2]]))


@pytest.mark.parametrize("shape", [(3,), (0, 3), (5, 3), (2, 4, 3), (5, 0)])
def test_vectors_come_apart_and_together(shape, dtype, rng):
    vectors = rng.normal(size=shape).astype(dtype)
    parts = fusion.components(vectors)
    assert len(parts) == shape[-1]
    for index, part in enumerate(parts):
        assert part.dtype == dtype
        np.testing.assert_array_equal(part, vectors[..., index])
    if parts:
        np.testing.assert_array_equal(fusion.stacked(parts), vectors)


def test_values_that_are_not_finite_stay_with_their_component(dtype):
    vector = jnp.asarray([np.nan, np.inf, -0.0], dtype)
    np.testing.assert_array_equal(
        fusion.stacked(fusion.components(vector)), vector, strict=True
    )
    slope = jax.grad(lambda x: jnp.sum(jnp.sqrt(fusion.components(x)[1])))
    np.testing.assert_array_equal(slope(jnp.zeros(3, dtype)), [0, np.inf, 0])


def test_derivatives_of_every_kind_are_those_of_plain_indices(float64, rng):
    vectors, toward = rng.normal(size=(6, 3)), rng.normal(size=3)

    def each(function):
        def value(x):
            return jnp.tanh(function(x)) @ toward

        yield jax.jit(jax.vmap(function, in_axes=1))(vectors.T)
        yield jax.jit(jax.vmap(jax.grad(value)))(vectors)
        yield jax.jit(jax.grad(lambda x: jnp.sum(jax.vmap(value)(x))))(vectors)
        yield jax.jit(jax.vmap(jax.vmap(jax.jacfwd(function))))(vectors[None])
        yield jax.jit(jax.vmap(jax.hessian(value)))(vectors)
        yield jax.jit(jax.vmap(jax.jacrev(jax.jacrev(value))))(vectors)

    for actual, expected in zip(each(ours), each(plain), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-14)
    assert gradients.directional_error(lambda x: ours(x) @ toward, vectors[0]) < 1e-7


def test_one_of_what_is_materialized_may_be_the_same_for_all(float64, rng):
    shared, each = rng.normal(size=3), rng.normal(size=(4, 3))

    def value(shared, own):
        return jnp.sum(
            fusion.materialized(jnp.sin(shared)) * fusion.materialized(own**2)
        )

    both = jax.jit(jax.vmap(jax.grad(value, (0, 1)), (None, 0)))(shared, each)
    np.testing.assert_allclose(both[0], np.cos(shared) * each**2, rtol=1e-12)
    np.testing.assert_allclose(both[1], 2 * np.sin(shared) * each, rtol=1e-12)


def test_a_compiled_program_computes_the_parts_before_the_stack():
    """Of XLA:CPU; a version that inlines the call would be right, and slow again."""

    def slope(vectors):
        return jax.grad(lambda x: jnp.sum(jax.vmap(ours)(x) ** 2))(vectors)

    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        text = jax.jit(slope).lower(np.ones((8, 3))).compile().as_text()
    # Three parts each of the stack, its cotangent, and the components' cotangent.
    assert text.count(" call(") == 9


def test_a_number_has_no_components():
    with pytest.raises(ValueError, match="a scalar has no components"):
        jax.jit(fusion.COMPONENTS.bind)(1.0)
