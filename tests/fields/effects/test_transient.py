"""The transient medium and its loss, against loops in NumPy and closed forms."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields.effects import transient
from nerfies_jax.fields.effects.effect import Batch, Medium, RayOutput, Sample
from nerfies_jax.fields.effects.transient import TransientSpec
from nerfies_jax.training.effects import (
    FrameCondition,
    PenaltyContext,
)
from tests import gradients, random_params
from tests.oracles import networks

SPEC = TransientSpec(code_width=3, depth=2, width=8)
FEATURES = 6


def condition(dtype, seed=1):
    code = jnp.asarray(np.random.default_rng(seed).normal(size=3), dtype)
    return FrameCondition(jnp.asarray(0.4, dtype), {"transient": code}, jnp.int32(0))


def sample(dtype, seed=2):
    rng = np.random.default_rng(seed)
    return Sample(
        *(jnp.asarray(rng.normal(size=size), dtype) for size in (3, 3, FEATURES))
    )


medium_of = jax.jit(transient.medium, static_argnums=0)
photometric = jax.jit(
    jax.value_and_grad(transient.photometric, (0, 1, 2)), static_argnums=4
)


def params_of(dtype):
    return random_params.like(
        lambda key: transient.init(SPEC, key, FEATURES), dtype, 0.1
    )


def medium_by_hand(params, met, when):
    raw = networks.heads(
        params, np.concatenate([met.features, when.codes["transient"]])
    )
    return (
        math.log1p(math.exp(raw["density"][0])),
        1 / (1 + np.exp(-raw["color"])),
        math.log1p(math.exp(raw["beta"][0])),
    )


def loss_by_hand(color, truth, beta, valid, power=0.0):
    """In float64, of the valid rays."""
    color, truth, beta = (networks.exact(x)[valid] for x in (color, truth, beta))
    squared = np.sum((color - truth) ** 2, axis=1)
    return np.mean((squared / (2 * beta**2) + np.log(beta)) * beta**power)


def test_the_medium_is_the_loop_over_its_layers(dtype):
    params, met, when = params_of(dtype), sample(dtype), condition(dtype)
    medium = medium_of(SPEC, params, met, when)
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    density, color, beta = medium_by_hand(params, met, when)
    np.testing.assert_allclose(medium.density, density, rtol=tolerance)
    np.testing.assert_allclose(medium.color, color, rtol=tolerance)
    np.testing.assert_allclose(medium.beta, beta, rtol=tolerance)
    assert medium.share is None  # both media have all of their opacity
    for leaf in (medium.density, medium.color, medium.beta):
        assert leaf.dtype == dtype


def test_the_trunk_learns_from_the_transient(float64, rng):
    """The gradient is not stopped, and it is right, for features, code and weights."""
    params, met, when = (of("float64") for of in (params_of, sample, condition))
    pull = jnp.asarray(rng.normal(size=5))

    def read(params, features, code):
        medium = transient.medium(
            SPEC,
            params,
            met._replace(features=features),
            when._replace(codes={"transient": code}),
        )
        values = [medium.density[None], medium.color, medium.beta[None]]
        return pull @ jnp.concatenate(values)

    args = (params, met.features, when.codes["transient"])
    assert gradients.directional_error(read, *args, step=1e-6) < 1e-7
    grad = np.asarray(jax.jit(jax.grad(read, argnums=1))(*args))
    assert np.all(np.abs(grad) > 1e-4)


@pytest.mark.hard_cases
@pytest.mark.parametrize("size", [1e3, 1e30])
def test_wild_features_leave_the_medium_finite_and_not_negative(size, dtype):
    params, when = params_of(dtype), condition(dtype)
    for sign in (-1, 1):
        met = sample(dtype)._replace(features=np.full(FEATURES, sign * size, dtype))
        medium = jax.tree.map(np.asarray, medium_of(SPEC, params, met, when))
        for leaf in (medium.density, medium.color, medium.beta):
            assert np.all(np.isfinite(leaf))
            assert np.all(leaf >= 0)
        assert np.all(medium.color <= 1)


def test_uncertainty_is_the_least_plus_what_is_met(dtype, rng):
    weights, beta = rng.uniform(size=(2, 4, 7)).astype(dtype)
    beta_of_ray = jax.jit(transient.uncertainty, static_argnums=0)(0.03, weights, beta)
    assert beta_of_ray.dtype == dtype
    exact = 0.03 + np.sum(networks.exact(weights) * beta, axis=1)
    tolerance = {"float32": 1e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(beta_of_ray, exact, rtol=tolerance)


@pytest.mark.hard_cases
def test_a_ray_that_meets_no_transient_has_the_least_uncertainty(dtype):
    weights = np.zeros((2, 5), dtype)
    beta = np.asarray([[0.1] * 5, [1e30] * 5], dtype)

    def loss(weights, beta):
        rays = transient.uncertainty(0.03, weights, beta)
        return transient.photometric(
            jnp.full((2, 3), 0.5, dtype), jnp.full((2, 3), 0.4, dtype), rays, None
        ), rays

    slopes_and_rays = jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))(
        weights, beta
    )
    grads, rays = jax.tree.map(np.asarray, slopes_and_rays)
    np.testing.assert_array_equal(rays, np.full(2, 0.03, dtype))
    assert np.all(np.isfinite(grads[0]))
    assert np.all(grads[1] == 0)
    # A residual above beta asks for more transient: the medium can come alive
    assert np.all(grads[0] < 0)


def rays_of(dtype, rng, count=9):
    color, truth = rng.uniform(size=(2, count, 3)).astype(dtype)
    beta = rng.uniform(0.03, 1, count).astype(dtype)
    return color, truth, beta, rng.uniform(size=count) < 0.7


@pytest.mark.parametrize("power", [0.0, 1.0])
def test_photometric_is_the_mean_of_the_valid_rays_alone(power, dtype, rng):
    color, truth, beta, valid = rays_of(dtype, rng)
    assert 0 < np.sum(valid) < len(valid)
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    for mask, counted in ((valid, valid), (None, valid | True)):
        loss, _ = photometric(color, truth, beta, mask, power)
        assert loss.dtype == dtype
        exact = loss_by_hand(color, truth, beta, counted, power)
        np.testing.assert_allclose(loss, exact, rtol=tolerance)


@pytest.mark.hard_cases
@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("offset", [0.0, 1e-30, 1e-7, 1e-3, 1.0, 1e4, 1e15])
def test_photometric_holds_from_no_residual_to_a_huge_one(offset, power, dtype):
    """The slopes of a power are those of zero times that power of beta, held still."""
    color = np.full((1, 3), offset, dtype)
    truth = np.zeros((1, 3), dtype)
    beta = np.asarray([0.03], dtype)
    value, grads = photometric(color, truth, beta, np.array([True]), power)
    residual, b = float(color[0, 0]), float(beta[0])
    exact = b**power * (3 * residual**2 / (2 * b**2) + math.log(b))
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(value, exact, rtol=tolerance)
    exact = b**power * residual / b**2
    np.testing.assert_allclose(grads[0], [[exact] * 3], rtol=tolerance)
    exact = b**power * (-3 * residual**2 / b**3 + 1 / b)
    np.testing.assert_allclose(grads[2], [exact], rtol=2 * tolerance)


@pytest.mark.hard_cases
@pytest.mark.parametrize("hole", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("power", [0.0, 1.0])
def test_unobserved_pixels_teach_nothing_whatever_they_hold(power, hole, dtype, rng):
    color, truth, beta = whole = rays_of(dtype, rng, 3)[:3]
    valid = np.array([True, False, True])
    broken = [leaf.copy() for leaf in whole]
    for leaf in broken:
        leaf[1] = hole
    value, grads = jax.tree.map(np.asarray, photometric(*broken, valid, power))
    exact = loss_by_hand(color, truth, beta, valid, power)
    np.testing.assert_allclose(value, exact, rtol=2e-6)
    for grad in grads:
        assert np.all(np.isfinite(grad))
        assert np.all(grad[1] == 0)
    nothing, _ = photometric(*broken, np.zeros(3, bool), power)
    assert float(nothing) == 0


def test_photometric_has_its_slopes(float64, rng):
    color, truth, _, valid = map(jnp.asarray, rays_of("float64", rng))

    def of_samples(color, truth, weights, beta):
        rays = transient.uncertainty(0.03, weights, beta)
        return transient.photometric(color, truth, rays, valid)

    samples = rng.uniform(size=(2, 9, 4))
    assert gradients.directional_error(of_samples, color, truth, *samples) < 1e-7


def context(dtype, density, valid):
    medium = Medium(density, jnp.zeros((*density.shape, 3), dtype))
    nothing = RayOutput(**dict.fromkeys(RayOutput._fields))
    weight = {"transient": jnp.full(density.shape, 0.5 / density.shape[-1], dtype)}
    fine = nothing._replace(media={"transient": medium}, media_weight=weight)
    batch = Batch(**dict.fromkeys(Batch._fields))
    return PenaltyContext(**dict.fromkeys(PenaltyContext._fields))._replace(
        levels=(nothing, fine),
        batch=batch._replace(valid=jnp.asarray(valid)),
    )


def test_the_penalty_is_the_mean_density_of_the_fine_samples(dtype):
    @jax.jit
    def penalty(density):
        return SPEC.loss(None, context(dtype, density, [True, True, False]))

    density = np.array([[0.0, 1.0, 2.0], [5.0, 4.0, 0.0], [1e6, 1.0, 1.0]], dtype)
    terms = penalty(density)
    assert set(terms) == {"density", "share"}
    # 12 over six samples; the third ray was not observed
    assert terms["density"].value == 2.0
    assert terms["density"].value.dtype == dtype
    np.testing.assert_allclose(terms["density"].weight, 0.01)
    # The share of the pixels that it explains is logged only.
    assert terms["share"].weight is None
    np.testing.assert_allclose(terms["share"].value, 0.5)


def test_a_held_medium_is_absent_at_first_and_can_start_thin(dtype):
    spec = dataclasses.replace(SPEC, density_bias=-6.0, hold_steps=10)
    params, met, when = params_of(dtype), sample(dtype), condition(dtype)
    usual = medium_of(SPEC, params, met, when)

    def at(step):
        return medium_of(spec, params, met, when._replace(step=jnp.int32(step)))

    assert at(9).density == 0
    thin = math.log1p(math.expm1(float(usual.density)) * math.exp(-6))
    np.testing.assert_allclose(at(10).density, thin, rtol=1e-4)
    np.testing.assert_array_equal(at(10).color, usual.color)
