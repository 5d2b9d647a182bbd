"""Sampling along rays and compositing, against loops and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields import rendering
from tests import gradients

composite = jax.jit(rendering.composite)


def reference(density, color, t, background, last):
    """One ray in float64, sample by sample."""
    passed, rendered, depth = 1.0, np.zeros(color.shape[-1]), 0.0
    weights = []
    for i in range(len(t)):
        length = last if i + 1 == len(t) else t[i + 1] - t[i]
        stopped = 1 - np.exp(-density[i] * length)
        weights.append(passed * stopped)
        rendered += weights[-1] * color[i]
        depth += weights[-1] * t[i]
        passed *= 1 - stopped
    alpha = sum(weights)
    missing = max(1e-3 - alpha, 0)
    depth = (depth + missing * t[-1]) / (alpha + missing)
    return rendered + (1 - alpha) * background, depth, np.array(weights), alpha


def random_samples(rng, dtype="float64"):
    density = rng.uniform(0, 2, (2, 3, 6))
    color = rng.uniform(size=(2, 3, 6, 4))
    t = np.sort(rng.uniform(1, 4, (3, 6)), axis=-1)
    background = rng.uniform(size=4)
    return [x.astype(dtype) for x in (density, color, t, background)]


def test_composite_is_a_loop_over_samples_for_any_leading_axes(dtype, rng):
    density, color, t, background = random_samples(rng, dtype)
    actual = composite(density, color, t, background, last_interval=0.5)
    assert actual.color.shape == (2, 3, 4)
    assert actual.weights.shape == (2, 3, 6)
    bound = {"float32": 2e-6, "float64": 1e-14}[dtype]
    for place in np.ndindex(2, 3):
        inputs = (density[place], color[place], t[place[1]], background)
        loop = reference(*(x.astype(np.float64) for x in inputs), 0.5)
        for one, other in zip(actual, loop, strict=True):
            assert one.dtype == dtype
            assert np.max(np.abs(one[place] - other)) < bound


@pytest.mark.parametrize(
    ("density", "weights"),
    [
        ((0, 0, 0), (0, 0, 0)),
        ((np.inf, 1, 1), (1, 0, 0)),
        ((0, np.inf, np.inf), (0, 1, 0)),
        ((0, 1e30, 0), (0, 1, 0)),
        ((0, 0, 1e-3), (0, 0, 1)),  # the last sample stands for all behind it
    ],
    ids=["empty", "opaque at once", "opaque later", "a wall", "a thin last sample"],
)
def test_empty_and_opaque_rays_have_exact_weights_and_finite_gradients(
    density, weights, dtype
):
    t = np.asarray([1, 1, 2] if density[1] == np.inf else [1, 2, 3], dtype)
    if density[1] == np.inf:  # an interval of no length in front of the wall
        t = np.asarray([1, 2, 2], dtype)
        weights = (0, 0, 1)
    arguments = (np.asarray(density, dtype), np.eye(3, dtype=dtype), t)

    def total(*arguments):
        actual = rendering.composite(*arguments)
        return jnp.sum(actual.color) + actual.depth, actual

    grads, actual = jax.jit(jax.grad(total, (0, 1, 2), has_aux=True))(*arguments)
    np.testing.assert_array_equal(actual.weights, np.asarray(weights, dtype))
    hit = float(t @ np.asarray(weights, dtype)) if any(weights) else float(t[-1])
    assert abs(float(actual.depth) - hit) < 1e-6
    assert all(np.isfinite(leaf).all() for leaf in grads)


def test_gradients_are_those_of_central_differences(float64, rng):
    density, color, t, background = random_samples(rng)
    weight = rng.normal(size=(2, 3, 4))

    def total(density, color, t, background):
        actual = rendering.composite(density, color, t, background, last_interval=0.5)
        return jnp.sum(weight * actual.color) + jnp.sum(jnp.sin(actual.depth))

    error = gradients.directional_error(total, density, color, t, background)
    assert error < 1e-8


@pytest.mark.parametrize("spacing", ["linear", "disparity"])
def test_samples_lie_one_in_each_bin_on_their_rays(spacing, dtype, rng):
    origins = rng.normal(size=(4, 5, 3)).astype(dtype)
    directions = rng.normal(size=(4, 5, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    directions = directions.astype(dtype)
    near = rng.uniform(0.5, 1, (4, 1)).astype(dtype)
    key = jax.random.key(3)
    t, points, along = rendering.sample_along_rays(
        key, origins, directions, near, 7.0, 8, spacing=spacing
    )
    assert t.dtype == points.dtype == dtype
    assert t.shape == (4, 5, 8)
    to = (lambda x: x) if spacing == "linear" else (lambda x: 1 / x)
    share = np.linspace(0, 1, 9)
    edges = to(near[..., None]) * (1 - share) + to(7.0) * share
    low, high = np.sort(np.stack([edges[..., :-1], edges[..., 1:]]), axis=0)
    assert np.all(to(np.asarray(t)) >= low * (1 - 1e-6))
    assert np.all(to(np.asarray(t)) <= high * (1 + 1e-6))
    place = (to(np.asarray(t, np.float64)) - low) / (high - low)
    assert 0.2 < place.mean() < 0.8
    assert np.unique(np.round(place, 4)).size > 140  # each ray has its own
    np.testing.assert_array_equal(along[..., 3, :], directions)
    expected = origins[..., None, :] + np.asarray(t)[..., None] * np.asarray(along)
    np.testing.assert_allclose(points, expected, atol=1e-5)
    middle, _, _ = rendering.sample_along_rays(
        None, origins, directions, near, 7.0, 8, spacing=spacing
    )
    np.testing.assert_allclose(
        to(np.asarray(middle)), np.broadcast_to((low + high) / 2, t.shape), rtol=1e-5
    )


@pytest.mark.parametrize("far", [1e7, np.inf])
def test_disparity_reaches_far_and_infinity_with_all_digits(far, dtype):
    one = np.asarray([0, 0, 1], dtype)
    actual = rendering.sample_along_rays(
        None, 0 * one, one, 1.0, far, 4, spacing="disparity"
    )
    share = (np.arange(4) + 0.5) / 4
    exact = 1 / ((1 - share) + share / far)
    bound = {"float32": 1e-6, "float64": 1e-14}[dtype]
    assert np.max(np.abs(actual.t / exact - 1)) < bound


def test_a_ray_that_ends_before_it_begins_has_its_samples_at_its_end(dtype):
    one = np.asarray([0, 0, 1], dtype)
    actual = rendering.sample_along_rays(jax.random.key(0), 0 * one, one, 3.0, 2.0, 4)
    np.testing.assert_array_equal(actual.t, np.full(4, 2, dtype))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"num_samples": 0}, "num_samples=0"),
        ({"spacing": "log"}, "'log'; choose from"),
        ({"far": np.inf}, "cannot reach far=inf; use spacing='disparity'"),
        ({"near": 0.0, "spacing": "disparity"}, "needs near > 0, got 0"),
        ({"near": np.ones(3)}, r"`near` has shape \[3\], which does not broadcast"),
        ({"near": np.ones((2, 4))}, r"`near` has shape \[2, 4\]"),
        ({"origins": np.ones((4, 2))}, r"`origins` has shape \[4, 2\], expected"),
        ({"directions": np.ones((5, 3))}, r"`directions` has shape \[5, 3\]"),
        ({"key": 0}, "`key` must be a key, got int32"),
    ],
)
def test_rays_that_cannot_be_sampled_are_refused(changes, words):
    inputs = dict(
        key=None,
        origins=np.zeros((4, 3), np.float32),
        directions=np.ones((4, 3), np.float32),
        near=1.0,
        far=2.0,
        num_samples=4,
    )
    with pytest.raises(ValueError, match=words):
        rendering.sample_along_rays(**(inputs | changes))
