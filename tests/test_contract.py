"""The checks in front of public functions: what they refuse, convert and cost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Bool, Float, Int, Key

from nerfies_jax.geometry.camera import Camera, look_at
from nerfies_jax.runtime.contract import checked


@checked
def pair(
    density: Float[Array, "*rays samples"],
    color: Float[Array, "*rays samples channels"],
    ids: Int[Array, " samples"] | None = None,
    mask: Bool[Array, " samples"] | None = None,
    key: Key[Array, ""] | None = None,
) -> Float[Array, "*rays channels"]:
    return jnp.sum(density[..., None] * color, axis=-2)


@checked(broadcast=True)
def weighted(
    vector: Float[Array, "3"], weight: Float[Array, ""], camera: Camera | None = None
) -> Float[Array, "3"]:
    moved = vector * weight
    return moved if camera is None else moved + camera.position


@checked(images=("image", "truth"))
def difference(
    image: Float[Array, "height width channels"],
    truth: Float[Array, "height width channels"],
) -> Float[Array, "height width channels"]:
    return image - truth


ONE = look_at((0, 0, -4), (0, 0, 0), (0, 1, 0), 50.0, (40, 30))
F32 = jnp.float32
REFUSED = {
    "too few axes": (
        lambda: pair(jnp.ones((2, 5)), jnp.ones((5, 3))),
        r"test_contract\.pair: `color` has shape \[5, 3\], expected \[\*rays, samples, "
        r"channels\] with \*rays = \[2\] from `density` and samples = 5",
    ),
    "two lengths": (
        lambda: pair(jnp.ones(5), jnp.ones((6, 3))),
        r"`color` has shape \[6, 3\].* samples = 5 from `density`",
    ),
    "integers": (
        lambda: pair(jnp.ones(5, int), jnp.ones((5, 3))),
        r"`density` must be floating-point, got int32\[5\]; cast it with",
    ),
    "complex": (
        lambda: pair(jnp.ones(5, complex), jnp.ones((5, 3))),
        r"`density` must be floating-point, got complex64",
    ),
    "float ids": (
        lambda: pair(jnp.ones(5), jnp.ones((5, 3)), jnp.ones(5)),
        r"`ids` must be integer, got float32",
    ),
    "a mask of bytes": (
        lambda: pair(jnp.ones(5), jnp.ones((5, 3)), mask=jnp.ones(5, jnp.uint8)),
        r"`mask` must be boolean, got uint8\[5\]; convert it",
    ),
    "a raw key": (
        lambda: pair(jnp.ones(5), jnp.ones((5, 3)), key=jax.random.PRNGKey(0)),
        r"`key` must be a key, got uint32\[2\]; create it with jax.random.key",
    ),
    "a list": (
        lambda: pair([1.0, 2.0], jnp.ones((2, 3))),
        r"`density` must be an array, got a list",
    ),
    "a number for a vector": (
        lambda: weighted(1.0, 2.0),
        r"`vector` must be an array, got a float",
    ),
    "too many axes": (
        lambda: difference(jnp.ones((2, 4, 4, 3)), jnp.ones((2, 4, 4, 3))),
        r"`image` has shape \[2, 4, 4, 3\].*; map over its leading axes with jax.vmap",
    ),
    "axes that do not broadcast": (
        lambda: weighted(jnp.ones((2, 3)), jnp.ones(5)),
        r"leading axes do not broadcast: \[2\] of `vector`, \[5\] of `weight`",
    ),
    "a last axis of another length": (
        lambda: weighted(jnp.ones((3, 4)), 1.0),
        r"`vector` has shape \[3, 4\], expected \[\.\.\., 3\]",
    ),
    "another record": (
        lambda: weighted(jnp.ones(3), 1.0, (1, 2)),
        r"`camera` must be a Camera, got a tuple",
    ),
    "a field of a record": (
        lambda: weighted(jnp.ones(3), 1.0, ONE._replace(position=np.ones(2, F32))),
        r"`camera.position` has shape \[2\], expected \[\.\.\., 3\]",
    ),
    "an image of int32": (
        lambda: difference(jnp.ones((4, 4, 3), int), jnp.ones((4, 4, 3))),
        r"`image` is int32\[4, 4, 3\]; images must be floating-point in",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_refused_by_name(name):
    call, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        call()


def test_a_shape_that_passed_does_not_excuse_another():
    assert pair(jnp.ones(5), jnp.ones((5, 3))).shape == (3,)
    assert pair(jnp.ones(5), jnp.ones((5, 3))).shape == (3,)
    with pytest.raises(ValueError, match="`color`"):
        pair(jnp.ones(5), jnp.ones((6, 3)))
    with pytest.raises(TypeError, match="missing 1 required"):
        pair(jnp.ones(5))
    with pytest.raises(TypeError, match="multiple values"):
        pair(jnp.ones(5), jnp.ones((5, 3)), density=1)


def test_leading_axes_broadcast_as_those_of_numpy(rng):
    vector, weight = rng.normal(size=(4, 1, 3)), rng.normal(size=(1, 5))
    vector, weight = vector.astype(np.float32), weight.astype(np.float32)
    actual = weighted(vector, weight=weight)
    np.testing.assert_array_equal(actual, vector * weight[..., None])
    assert weighted(vector[:0], weight).shape == (0, 5, 3)
    cameras = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), ONE)
    moved = weighted(vector, 2.0, cameras)  # [4, 1], [], [2]
    expected = 2 * np.broadcast_to(vector, (4, 2, 3)) + ONE.position
    np.testing.assert_array_equal(moved, expected)


def test_integer_and_gray_images_are_converted_as_documented():
    full = np.full((4, 5), 255, np.uint8)
    deep = np.full((4, 5, 1), 65535 // 2, np.uint16)
    actual = difference(full, deep)
    assert actual.dtype == jnp.float32
    np.testing.assert_allclose(actual, np.full((4, 5, 1), 1 - 32767 / 65535), rtol=1e-6)
    with jax.enable_x64(True):
        exact = difference(full, jnp.zeros((4, 5), jnp.float64))
        assert exact.dtype == jnp.float64
        np.testing.assert_array_equal(exact, np.ones((4, 5, 1)))


def test_it_works_under_every_transformation_and_adds_no_operation():
    vectors, weights = jnp.ones((4, 3)), jnp.arange(4.0)

    def total(function):
        return lambda v, w: jnp.sum(function(v, w) ** 2)

    bare = weighted.__wrapped__
    for transformed in (
        lambda f: jax.vmap(f),
        lambda f: jax.vmap(jax.grad(total(f), (0, 1))),
        lambda f: jax.vmap(jax.jacfwd(f, (0, 1))),
        lambda f: jax.vmap(jax.hessian(total(f))),
    ):
        texts = [
            jax.jit(transformed(f)).lower(vectors, weights).as_text()
            for f in (weighted, bare)
        ]
        assert texts[0] == texts[1]
    shape = jax.eval_shape(weighted, jax.ShapeDtypeStruct((7, 3), F32), 1.0)
    assert shape.shape == (7, 3)
    with pytest.raises(ValueError, match=r"`vector` has shape \[4\]"):
        jax.eval_shape(weighted, jax.ShapeDtypeStruct((4,), F32), 1.0)
