"""Distortion loss against a sum over all pairs of points, and its gradients."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields import compositing
from nerfies_jax.fields.effects import ray_distortion
from tests import gradients


def a_ray(rng, dtype, samples=9):
    weights = rng.dirichlet(np.ones(samples)) * 0.9
    edges = np.sort(rng.uniform(0, 1, samples + 1))
    return jnp.asarray(weights, dtype), jnp.asarray(edges, dtype)


def of_pairs(weights, edges, points=4000):
    """Mean distance of points drawn from a ray's histogram, by a fine quadrature."""
    weights, edges = np.asarray(weights, float), np.asarray(edges, float)
    share = np.repeat(weights / points, points)
    place = np.concatenate(
        [
            left + (right - left) * (np.arange(points) + 0.5) / points
            for left, right in itertools.pairwise(edges)
        ]
    )
    # For sorted places: Σ_ij s_i s_j |x_i - x_j| = 2 Σ_j s_j (x_j S_j - M_j).
    before, weighted = (
        np.cumsum(share) - share,
        np.cumsum(share * place) - share * place,
    )
    return 2 * np.sum(share * (place * before - weighted))


def test_distortion_is_the_mean_distance_between_points(dtype, rng):
    weights, edges = a_ray(rng, dtype)
    loss = ray_distortion.distortion_loss(weights, edges)
    assert loss.dtype == dtype
    np.testing.assert_allclose(loss, of_pairs(weights, edges), rtol=1e-6)


def test_gradients_of_the_distortion(rng):
    with jax.enable_x64(True):
        error = gradients.directional_error(
            ray_distortion.distortion_loss, *a_ray(rng, "float64")
        )
    assert error < 1e-7


@pytest.mark.hard_cases
def test_weight_at_one_place_has_no_distortion(dtype, rng):
    """Also of a ray without weight, and with intervals without length or end."""
    empty, edges = a_ray(rng, dtype)
    empty = 0 * empty
    for weights, ends in (
        (empty, edges),
        (empty.at[3].set(1), edges.at[4].set(edges[3])),
        (empty.at[-1].set(1), edges.at[-2:].set(1)),
    ):
        value, slopes = jax.value_and_grad(ray_distortion.distortion_loss, (0, 1))(
            weights, ends
        )
        assert value == 0
        assert all(jnp.isfinite(leaf).all() for leaf in slopes)


@pytest.mark.hard_cases
def test_a_last_sample_at_infinity_ends_at_one(dtype):
    distances = jnp.asarray([0.0, 1.0, 3.0], dtype)
    spacing = compositing.intervals(distances, compositing.AT_INFINITY)
    ends = ray_distortion.contracted_edges(distances, spacing)
    np.testing.assert_allclose(ends, [0, 0.5, 0.75, 1], rtol=1e-6)


def test_surfaces_that_are_close_do_not_cancel(dtype):
    """Float32 keeps all digits of two surfaces that are 1e-4 apart, at distance one."""
    edges = jnp.asarray([0.9, 0.9001, 0.9002], dtype)
    loss = ray_distortion.distortion_loss(jnp.asarray([0.5, 0.5], dtype), edges)
    exact = np.asarray(edges, float)
    np.testing.assert_allclose(
        loss, of_pairs([0.5, 0.5], exact), rtol=1e-6 if dtype == "float64" else 1e-5
    )
