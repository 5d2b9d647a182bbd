"""Forward mode of the rasterizer, and Hessian-vector products, against differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.splatting import raster
from gaussians_jax.splatting.raster_spec import GSPLAT
from tests.gaussians.test_raster import footprints_from

SIZE, COUNT = (13, 9), 12
# Small chunks compile faster; 16 pairs are less than there are.
SPEC = dataclasses.replace(GSPLAT, batch=4, chunk=1, capacity=16, kept_chunks=2)
STEP = 1e-6


def some_inputs(rng):
    """Means, whitenings, opacities and values; one Gaussian is above the clamp."""
    opacity = rng.uniform(0.2, 0.8, COUNT)
    opacity[0] = 1.0
    footprints, _ = footprints_from(
        rng.uniform(0, 1, (COUNT, 2)) * SIZE,
        3 * np.exp(rng.normal(0, 0.3, (COUNT, 2))),
        rng.uniform(0, np.pi, COUNT),
        opacity,
        rng.uniform(1, 9, COUNT),
        "float64",
    )
    inputs = (*(np.asarray(x) for x in footprints[:3]), rng.normal(size=(COUNT, 2)))
    return footprints, inputs, [rng.normal(size=x.shape) * np.abs(x) for x in inputs]


def image_of(footprints, spec, *inputs):
    mean_px, whitening, opacity, values = inputs
    moved = footprints._replace(mean_px=mean_px, whitening=whitening, opacity=opacity)
    image, left = raster.rasterize(moved, values, SIZE, spec)
    return jnp.concatenate([image, left[..., None]], axis=-1)


def loss_of(footprints, spec, *inputs):
    return jnp.sum(jnp.sin(3 * image_of(footprints, spec, *inputs)))


def moved(inputs, along, sign):
    return tuple(x + sign * STEP * d for x, d in zip(inputs, along, strict=True))


def test_the_forward_derivative_of_the_image_equals_differences(float64, rng):
    footprints, inputs, along = some_inputs(rng)
    function = functools.partial(image_of, footprints, SPEC)
    forward = jax.jit(lambda x, d: jax.jvp(function, x, d))
    image, tangent = forward(inputs, tuple(along))
    ends = [
        np.asarray(forward(moved(inputs, along, sign), tuple(along))[0])
        for sign in (1, -1)
    ]
    difference = (ends[0] - ends[1]) / (2 * STEP)
    assert image.shape == (*SIZE[::-1], 3)
    error = np.abs(np.asarray(tangent) - difference).max()
    assert error < 1e-6 * np.abs(difference).max()


def test_hessian_vector_products_equal_differences_of_the_gradient(float64, rng):
    footprints, inputs, along = some_inputs(rng)
    gradient = jax.grad(functools.partial(loss_of, footprints, SPEC), (0, 1, 2, 3))
    both = jax.jit(lambda x, d: jax.jvp(gradient, x, d))
    _, product = both(inputs, tuple(along))
    ahead, behind = (both(moved(inputs, along, s), tuple(along))[0] for s in (1, -1))
    for one, up, down in zip(product, ahead, behind, strict=True):
        difference = (np.asarray(up) - np.asarray(down)) / (2 * STEP)
        error = np.abs(np.asarray(one) - difference).max()
        assert error < 1e-6 * np.abs(difference).max()


@pytest.mark.full
@pytest.mark.parametrize("clamp", ["zero", "through"])
def test_forward_and_reverse_mode_agree_at_the_clamp(clamp, float64, rng):
    """Differences cannot tell: "through" is the derivative of no function."""
    spec = dataclasses.replace(SPEC, clamp_gradient=clamp, alpha_max=0.5)
    footprints, inputs, along = some_inputs(rng)
    function = functools.partial(loss_of, footprints, spec)
    forward = jax.jit(lambda x, d: jax.jvp(function, x, d)[1])(inputs, tuple(along))
    gradient = jax.jit(jax.grad(function, (0, 1, 2, 3)))(*inputs)
    pairs = zip(gradient, along, strict=True)
    reverse = sum(np.sum(np.asarray(g) * d) for g, d in pairs)
    assert float(forward) == pytest.approx(reverse, rel=1e-10)


@pytest.mark.full
def test_forward_mode_under_vmap_equals_single_calls(float64, rng):
    """A Jacobian by columns: both the tangents alone and all inputs are batched."""
    footprints, inputs, along = some_inputs(rng)
    function = functools.partial(image_of, footprints, SPEC)

    def one(inputs, along):
        return jax.jvp(function, inputs, along)[1]

    ways = [tuple(along), tuple(-2 * d for d in along)]
    stacked = tuple(np.stack(pair) for pair in zip(*ways, strict=True))
    single = np.asarray(jax.jit(one)(inputs, ways[0]))
    batched = jax.jit(jax.vmap(one, (None, 0)))(inputs, stacked)
    np.testing.assert_allclose(batched[0], single, rtol=1e-12)
    np.testing.assert_allclose(batched[1], -2 * single, rtol=1e-12)
    every = tuple(np.stack([x, x]) for x in inputs)
    np.testing.assert_allclose(
        jax.jit(jax.vmap(one))(every, stacked), batched, rtol=1e-12
    )
