"""The template against NumPy, layer by layer, and central differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.radiance import template
from nerfies_jax.radiance.template import TemplateSpec
from tests import gradients

SMALL = TemplateSpec(depth=4, width=16, skips=(2,), colour_width=8)
INPUTS, CONDITION = 7, 5


def drawn(dtype, spec=SMALL, condition=CONDITION):
    """Parameters with biases that are not zero, and inputs."""
    dtype = jnp.dtype(dtype)
    shapes = jax.eval_shape(
        lambda key: template.init(spec, key, INPUTS, condition, dtype),
        jax.random.key(0),
    )
    rng = np.random.default_rng(1)

    def draw(leaf):
        size = np.sqrt(2 / sum(leaf.shape)) if len(leaf.shape) > 1 else 0.1
        return jnp.asarray((size * rng.normal(size=leaf.shape)).astype(dtype))

    params = jax.tree.map(draw, shapes)
    features, condition = (
        rng.normal(size=n).astype(dtype) for n in (INPUTS, condition)
    )
    return params, jnp.asarray(features), jnp.asarray(condition)


def by_hand(spec, params, features, condition, noise=0.0):
    def affine(layer, x):
        weight, bias = (np.asarray(leaf, np.float64) for leaf in layer)
        return x @ weight + bias

    features, condition = (np.asarray(x, np.float64) for x in (features, condition))
    hidden = features
    for index, layer in enumerate(params.trunk.hidden):
        if index in spec.skips:
            hidden = np.concatenate([hidden, features])
        hidden = np.maximum(affine(layer, hidden), 0)
    raw = affine(params.trunk.heads["density"], hidden)[0] + spec.density_bias + noise
    density = np.logaddexp(raw, 0) if spec.density == "softplus" else max(raw, 0)
    branch = np.concatenate(
        [affine(params.trunk.heads["bottleneck"], hidden), condition]
    )
    branch = np.maximum(affine(params.colour.hidden[0], branch), 0)
    colour = 1 / (1 + np.exp(-affine(params.colour.heads["colour"], branch)))
    return density, colour, hidden


@pytest.mark.parametrize("density", template.DENSITIES)
@pytest.mark.parametrize("condition", [CONDITION, 0])
@pytest.mark.parametrize("noise", [None, -0.7])
def test_density_colour_and_features_layer_by_layer(density, condition, noise, dtype):
    spec = dataclasses.replace(SMALL, density=density, density_bias=2.0)
    params, *inputs = drawn(dtype, condition=condition)
    added = None if noise is None else jnp.asarray(noise, dtype)
    found = template.apply(spec, params, *inputs, added)
    truth = by_hand(spec, params, *inputs, noise or 0.0)
    bound = {"float32": 3e-6, "float64": 1e-13}[dtype]
    for value, exact in zip(found, truth, strict=True):
        assert value.dtype == dtype
        np.testing.assert_allclose(value, exact, rtol=bound, atol=bound)
    assert found.density > 0


def test_gradients(float64):
    params, features, condition = drawn("float64")

    def total(params, features, condition):
        found = template.apply(SMALL, params, features, condition)
        return found.density**2 + jnp.sum(found.colour) + jnp.sum(found.features**2)

    error = gradients.directional_error(total, params, features, condition, step=1e-6)
    assert error < 1e-6


def test_density_does_not_depend_on_where_it_is_seen_from(dtype):
    """Nor, therefore, do depth, opacity and the samples of the fine level."""
    params, features, condition = drawn(dtype)
    found = jax.vmap(template.apply, (None, None, None, 0))(
        SMALL, params, features, jnp.stack([condition, -condition, 9 * condition])
    )
    assert np.all(found.density == found.density[0])
    assert np.all(found.features == found.features[0])
    assert np.all(np.ptp(found.colour, axis=0) > 1e-3)


@pytest.mark.full
def test_the_samples_of_a_ray_share_the_product_of_their_view(float64):
    params, features, condition = drawn("float64")
    points = jnp.stack([features, -features, 2 * features])
    along = jax.vmap(
        lambda features: template.apply(SMALL, params, features, condition)
    )
    for row, point in enumerate(points):
        truth = by_hand(SMALL, params, point, condition)
        for value, exact in zip(along(points), truth, strict=True):
            np.testing.assert_allclose(value[row], exact, rtol=1e-12)
    text = str(jax.make_jaxpr(along)(points))
    assert "f64[3,5]" not in text
    assert f"f64[3,{SMALL.width + CONDITION}]" not in text


@functools.partial(jax.jit, static_argnums=0)
def density_and_slope(spec, params, features, condition, noise):
    def at(noise):
        return template.apply(spec, params, features, condition, noise).density

    return jax.value_and_grad(at)(noise)


@pytest.mark.hard_cases
@pytest.mark.parametrize("raw", [-1e4, -100.0, 0.0, 100.0, 1e4])
@pytest.mark.parametrize("density", template.DENSITIES)
def test_any_raw_density_has_a_finite_value_and_slope(raw, density, dtype):
    params, *inputs = drawn(dtype)
    spec = dataclasses.replace(SMALL, density=density)
    noise = np.asarray(raw, dtype)
    value, grad = map(float, density_and_slope(spec, params, *inputs, noise))
    assert 0 <= value < 1.1e4
    assert 0 <= grad <= 1
    if density == "softplus" and raw > -99:
        assert grad > 0  # a ray of air can still become a surface


def test_parameters_have_the_sizes_of_the_paper():
    """Mildenhall et al. 2020, figure 7: one network is 595 844 numbers."""
    spec = TemplateSpec()
    inputs, condition = spec.position.width(3), spec.direction.width(3)
    params = template.init(spec, jax.random.key(0), inputs, condition)
    assert (inputs, condition) == (63, 27)
    assert sum(x.size for x in jax.tree.leaves(params)) == 595_844


@pytest.mark.full
def test_coarse_and_fine_templates_start_apart():
    one, other = (
        template.init(SMALL, jax.random.key(seed), INPUTS, CONDITION)
        for seed in range(2)
    )
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert np.all(a == 0) or np.any(a != b)  # biases start at zero


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"density": "exp"}, "'exp'.*softplus"),
        ({"colour_width": 0}, "colour_width=0"),
    ],
)
def test_wrong_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        TemplateSpec(**change)


def test_a_field_without_views_reads_codes_alone():
    spec = dataclasses.replace(SMALL, direction=None, position=EncodingSpec(2))
    assert template.colour_spec(spec, 3).inputs == spec.width + 3
    assert template.trunk_spec(spec, 15).inputs == 15


@pytest.mark.full
@pytest.mark.hard_cases
def test_bfloat16_is_finite_and_near():
    params, features, condition = drawn("bfloat16")
    spec = dataclasses.replace(SMALL, density="softplus")

    def seen(params):
        found = template.apply(spec, params, features, condition)
        return found.density + jnp.sum(found.colour), found

    (_, found), grads = jax.jit(jax.value_and_grad(seen, has_aux=True))(params)
    kinds = {leaf.dtype for leaf in jax.tree.leaves((found, grads))}
    assert kinds == {jnp.dtype(jnp.bfloat16)}
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))
    wide = jax.tree.map(lambda x: np.asarray(x, np.float64), (params, features))
    exact = by_hand(spec, *wide, np.asarray(condition, np.float64))
    np.testing.assert_allclose(np.asarray(found.density, float), exact[0], rtol=0.05)
    np.testing.assert_allclose(np.asarray(found.colour, float), exact[1], atol=0.02)
