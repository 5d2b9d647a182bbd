"""The template against NumPy, layer by layer, and central differences."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate

from nerfies_jax.fields import template
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.nn.planes import PlanesSpec
from tests import gradients
from tests import random_params as values
from tests.oracles import networks

SMALL = TemplateSpec(depth=4, width=16, skips=(2,), color_width=8)
INPUTS, CONDITION = 7, 5


def random_template(dtype, spec=SMALL, condition=CONDITION):
    """Parameters with biases that are not zero, and inputs."""
    params = values.like(
        lambda key: template.init(spec, key, INPUTS, condition), dtype, 0.1
    )
    rng, kind = np.random.default_rng(1), jnp.dtype(dtype)
    return params, *(rng.normal(size=n).astype(kind) for n in (INPUTS, condition))


def by_hand(spec, params, features, condition, noise=0.0):
    features, condition = networks.exact((features, condition))
    hidden = networks.trunk(params.trunk.hidden, features, spec.skips)
    heads = networks.heads(params.trunk, features, spec.skips)
    raw = heads["density"][0] + spec.density_bias + noise
    density = np.logaddexp(raw, 0) if spec.density == "softplus" else max(raw, 0)
    beside = np.concatenate([heads["bottleneck"], condition])
    color = 1 / (1 + np.exp(-networks.heads(params.color, beside)["color"]))
    return density, color, hidden


apply = jax.jit(template.apply, static_argnums=0)


@pytest.mark.parametrize(
    ("density", "condition", "noise"),
    [
        ("softplus", CONDITION, -0.7),
        ("relu", CONDITION, None),
        pytest.param("softplus", 0, None, marks=pytest.mark.full),
    ],
)
def test_density_color_and_features_layer_by_layer(density, condition, noise, dtype):
    spec = dataclasses.replace(SMALL, density=density, density_bias=2.0)
    params, *inputs = random_template(dtype, condition=condition)
    added = None if noise is None else np.asarray(noise, dtype)
    answer = apply(spec, params, *inputs, added)
    truth = by_hand(spec, params, *inputs, noise or 0.0)
    bound = {"float32": 3e-6, "float64": 1e-13}[dtype]
    for value, exact in zip(answer, truth, strict=True):
        assert value.dtype == dtype
        np.testing.assert_allclose(value, exact, rtol=bound, atol=bound)
    assert answer.density > 0
    wider = np.append(inputs[1], np.asarray(0, dtype))
    with pytest.raises(ValueError, match=f"condition has {condition + 1}; give `init`"):
        apply(spec, params, inputs[0], wider, added)


def test_gradients(float64):
    params, features, condition = random_template("float64")

    def total(params, features, condition):
        answer = template.apply(SMALL, params, features, condition)
        return answer.density**2 + jnp.sum(answer.color) + jnp.sum(answer.features**2)

    error = gradients.directional_error(total, params, features, condition, step=1e-6)
    assert error < 1e-6


def test_density_does_not_depend_on_where_it_is_seen_from(dtype):
    """Nor, therefore, do depth, opacity and the samples of the fine level."""
    params, features, condition = random_template(dtype)
    views = np.stack([condition, -condition, 9 * condition])
    seen = jax.jit(jax.vmap(functools.partial(template.apply, SMALL), (None, None, 0)))
    answer = jax.tree.map(np.asarray, seen(params, features, views))
    assert np.all(answer.density == answer.density[0])
    assert np.all(answer.features == answer.features[0])
    assert np.all(np.ptp(answer.color, axis=0) > 1e-3)


PLANES = dataclasses.replace(
    SMALL,
    position=PlanesSpec(vertices=3, multiples=(1, 2), features=2),
    anneal_steps=40,
)
TIMED = dataclasses.replace(
    PLANES, position=dataclasses.replace(PLANES.position, timestamps=4)
)


def planes_drawn(dtype, spec=PLANES):
    return values.like(
        lambda key: template.init(spec, key, spec.encoded_width, 1), dtype, 0.1
    )


def product_of_planes(level, place):
    """Of one place by SciPy's interpolation of the three or six planes of a level."""
    sides = ((0, 1), (0, 2), (1, 2), (3, 0), (3, 1), (3, 2))[: 3 * (len(place) - 2)]
    product = 1
    for pair, plane in zip(sides, level.space + level.time, strict=True):
        axes = [np.linspace(0, 1, side) for side in plane.shape[:2]]
        oracle = scipy.interpolate.RegularGridInterpolator(axes, np.asarray(plane))
        product = product * oracle(place[list(pair)])[0]
    return product


@pytest.mark.parametrize(
    ("point", "place"),
    [((0.3, -0.2, 0.9), (0.575, 0.45, 0.725)), ((-4, 1, 0), (0.0625, 0.609375, 0.5))],
    ids=["in the box", "contracted"],
)
def test_planes_say_where_a_point_is(point, place, dtype):
    """Half-way through the annealing the fine level is shut."""
    params, place = planes_drawn(dtype), np.asarray(place)
    levels = [product_of_planes(level, place) for level in params.tables]
    read = jax.jit(template.encode, static_argnums=0)
    at = functools.partial(read, PLANES, params, np.asarray(point, dtype))
    atol = {"float32": 1e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(at(None), np.concatenate(levels), rtol=0, atol=atol)
    shut = np.concatenate([levels[0], 0 * levels[1]])
    np.testing.assert_allclose(at(jnp.int32(20)), shut, rtol=0, atol=atol)


@pytest.mark.full
def test_gradients_of_planes(float64):
    params, point = planes_drawn("float64"), np.array([0.31, -0.23, 1.7])

    def total(params, point):
        return jnp.sum(template.encode(PLANES, params, point, None) ** 2)

    assert gradients.directional_error(total, params, point) < 1e-7


def test_planes_with_time_depend_on_it(dtype):
    params, place = planes_drawn(dtype, TIMED), np.array([0.575, 0.45, 0.725, 0.4])
    levels = [product_of_planes(level, place) for level in params.tables]
    point, time = np.asarray([0.3, -0.2, 0.9], dtype), np.asarray(0.4, dtype)
    read = jax.jit(template.encode, static_argnums=0)
    at = functools.partial(read, TIMED, params, point, None)
    atol = {"float32": 1e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(at(time), np.concatenate(levels), rtol=0, atol=atol)
    with pytest.raises(ValueError, match="have 4 dimensions, but the points have 3"):
        at(None)


@pytest.mark.full
def test_gradients_of_planes_with_time(float64):
    params = planes_drawn("float64", TIMED)
    point, time = np.array([0.31, -0.23, 1.7]), np.asarray(0.41)

    def total(params, point, time):
        return jnp.sum(template.encode(TIMED, params, point, None, time) ** 2)

    assert gradients.directional_error(total, params, point, time) < 1e-7


@functools.partial(jax.jit, static_argnums=0)
def density_and_slope(spec, params, features, condition, noise):
    def at(noise):
        return template.apply(spec, params, features, condition, noise).density

    return jax.value_and_grad(at)(noise)


@pytest.mark.hard_cases
@pytest.mark.parametrize("raw", [-1e4, -100.0, 0.0, 100.0, 1e4])
@pytest.mark.parametrize("density", template.DENSITIES)
def test_any_raw_density_has_a_finite_value_and_slope(raw, density, dtype):
    params, *inputs = random_template(dtype)
    spec = dataclasses.replace(SMALL, density=density)
    noise = np.asarray(raw, dtype)
    value, grad = map(float, density_and_slope(spec, params, *inputs, noise))
    steepest = math.exp(template.LARGEST_LOG) if density == "exp" else 1
    assert 0 <= value < 1.1e4 * steepest
    assert 0 <= grad <= 1.001 * steepest
    if density != "relu" and raw > -99:
        assert grad > 0  # a ray of air can still become a surface


def test_parameters_have_the_sizes_of_the_paper():
    """Mildenhall et al. 2020, figure 7: one network is 595 844 numbers."""
    spec, key = TemplateSpec(), jax.random.key(0)
    widths = spec.position.width(3), spec.direction.width(3)
    assert widths == (63, 27)
    params = jax.eval_shape(lambda key: template.init(spec, key, *widths), key)
    assert sum(x.size for x in jax.tree.leaves(params)) == 595_844


@pytest.mark.full
@pytest.mark.hard_cases
def test_bfloat16_is_finite_and_near():
    params, features, condition = random_template("bfloat16")
    spec = dataclasses.replace(SMALL, density="softplus")

    def seen(params, *inputs):
        answer = template.apply(spec, params, *inputs)
        return answer.density + jnp.sum(answer.color), answer

    slope = jax.jit(jax.value_and_grad(seen, has_aux=True))
    (_, answer), grads = slope(params, features, condition)
    kinds = {leaf.dtype for leaf in jax.tree.leaves((answer, grads))}
    assert kinds == {jnp.dtype(jnp.bfloat16)}
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))
    wide = jax.tree.map(lambda x: np.asarray(x, np.float64), (params, features))
    exact = by_hand(spec, *wide, np.asarray(condition, np.float64))
    np.testing.assert_allclose(np.asarray(answer.density, float), exact[0], rtol=0.05)
    np.testing.assert_allclose(np.asarray(answer.color, float), exact[1], atol=0.02)
