"""Depth losses: their values, their blindness, and images that say nothing."""

import functools

import jax
import numpy as np
import pytest
import scipy.stats

from gaussians_jax.losses import depth
from gaussians_jax.losses.depth import DepthSpec
from nerfies_jax.training.effects import (
    Observation,
    PenaltyContext,
    values,
    weighted_sum,
)
from nerfies_jax.training.model import Rendering
from tests import gradients
from tests.gaussians.shared import full, jitted, put

COUNT = 31
FORMS = {name: jitted(form) for name, form in depth.FORMS.items()}
SLOPES = {name: jitted(jax.value_and_grad(form)) for name, form in depth.FORMS.items()}
nth_smallest = jitted(depth.nth_smallest)
EVERYWHERE = np.ones(COUNT, bool)


def two_depths(dtype, seed=0):
    rng = np.random.default_rng(seed)
    depths = rng.uniform(1, 4, (2, COUNT)).astype(dtype)
    known = rng.uniform(size=COUNT) < 0.7
    return *depths, known


def expected_loss(kind, rendered, truth):
    """From the known pixels alone, in NumPy and SciPy."""
    if kind == "metric":
        return np.abs(rendered - truth).mean() / truth.mean()
    if kind == "correlation":
        return 1 - scipy.stats.pearsonr(rendered, truth).statistic

    def normalized(x):
        middle = np.sort(x)[(len(x) - 1) // 2]
        return (x - middle) / np.abs(x - middle).mean()

    return np.abs(normalized(rendered) - normalized(truth)).mean()


@pytest.mark.parametrize(
    "seed", [0, 1, *full(2)]
)  # even and odd numbers of known pixels
@pytest.mark.parametrize("kind", depth.KINDS)
def test_losses_are_those_of_the_known_pixels(kind, seed, dtype):
    rendered, truth, known = two_depths(dtype, seed)
    value = FORMS[kind](rendered, truth, known)
    chosen = np.asarray(known)
    expected = expected_loss(
        kind, *(np.asarray(x, np.float64)[chosen] for x in (rendered, truth))
    )
    assert value.dtype.name == dtype
    tolerance = {"float32": 1e-5, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(value, expected, rtol=tolerance)


@pytest.mark.parametrize("kind", depth.KINDS)
def test_gradients(kind, float64):
    rendered, truth, known = map(put, two_depths("float64"))

    def total(rendered):
        return depth.FORMS[kind](rendered, truth, known)

    assert gradients.directional_error(total, rendered, step=1e-6) < 1e-6
    assert not SLOPES[kind](rendered, truth, known)[1][~np.asarray(known)].any()


@pytest.mark.hard_cases
@pytest.mark.parametrize("kind", ["affine", "correlation"])
@pytest.mark.parametrize(("scale", "offset"), [(1e-3, 0.0), (50.0, 20.0)])
def test_scale_and_offset_are_not_seen(kind, scale, offset, dtype):
    rendered, truth, known = two_depths(dtype)
    value, _ = SLOPES[kind](rendered, truth, known)
    moved, _ = SLOPES[kind](rendered * scale + offset, truth, known)
    tolerance = {"float32": 2e-5, "float64": 1e-11}[dtype]
    np.testing.assert_allclose(moved, value, rtol=tolerance)
    same, _ = SLOPES[kind](truth * 3 + 1, truth, known)
    # In float32 the correlation keeps 1e-12: 1 - r would keep 1e-7.
    limit = {"affine": {"float32": 2e-6}, "correlation": {"float32": 1e-11}}[kind]
    assert 0 <= same <= limit.get(dtype, 1e-13)


@pytest.mark.hard_cases
def test_the_affine_loss_is_level_where_every_pixel_is_on_the_wrong_side(dtype):
    """Then mean |a - b| = mean |a| + mean |b| = 2: what the docstring warns of."""
    truth = np.linspace(1, 3, COUNT, dtype=dtype)
    value, grad = SLOPES["affine"](5 - truth, truth, EVERYWHERE)
    np.testing.assert_allclose(value, 2, rtol=1e-6)
    assert np.abs(grad).max() < 1e-6


def hard_images():
    rng = np.random.default_rng(0)
    ramp = np.linspace(1, 3, COUNT)
    flat = np.full(COUNT, 2.0)
    all_known, none = np.ones(COUNT, bool), np.zeros(COUNT, bool)
    one, two = none.copy(), none.copy()
    one[4], two[4], two[9] = True, True, True
    two_levels = np.where(np.arange(COUNT) < 3, 1.0, 2.0)  # median deviation is zero
    return {
        "nothing known": (ramp, ramp[::-1], none),
        "one pixel": (ramp, flat, one),
        "two pixels": (ramp, flat + ramp, two),
        "two equal pixels": (flat, ramp, two),
        "flat truth": (ramp, flat, all_known),
        "flat drawing": (flat, ramp, all_known),
        "both flat": (flat, 3 * flat, all_known),
        "few outliers on a plane": (two_levels, ramp, all_known),
        "deviation of an ulp": (1000 + 1e-4 * rng.normal(size=COUNT), ramp, all_known),
        "tiny depths": (1e-6 * ramp, 1e-6 * ramp[::-1], all_known),
        "huge depths": (1e6 * ramp, 1e6 * ramp[::-1], all_known),
        "one far outlier": (np.append(ramp[1:], 1e6), ramp, all_known),
        "inside out": (ramp, 5 - ramp, all_known),
    }


@pytest.mark.hard_cases
@pytest.mark.parametrize("kind", depth.KINDS)
@pytest.mark.parametrize("name", hard_images())
def test_images_that_say_little_stay_finite(kind, name, dtype):
    rendered, truth, known = hard_images()[name]
    value, grad = SLOPES[kind](rendered.astype(dtype), truth.astype(dtype), known)
    assert np.isfinite(value)
    assert np.isfinite(grad).all()
    # Slopes are at most a thousand over the depth of the image.
    assert np.abs(grad).max() * np.median(rendered) < 1100
    if known.sum() < 2 and kind != "metric":
        assert value == 0
        assert not np.asarray(grad).any()


@pytest.mark.hard_cases
def test_a_flat_drawing_is_bent_toward_the_truth(dtype):
    truth = np.linspace(1, 3, COUNT, dtype=dtype)
    for kind in ("affine", "correlation"):
        grad = SLOPES[kind](np.full(COUNT, 2.0, dtype), truth, EVERYWHERE)[1]
        assert np.corrcoef(np.asarray(grad), np.asarray(truth))[0, 1] < -0.8


@pytest.mark.hard_cases
@pytest.mark.parametrize("count", [1, 2, 20])
def test_the_nth_smallest_is_that_of_a_sort(count, dtype):
    rng = np.random.default_rng(count)
    values = np.exp(rng.uniform(-60, 60, 20)).astype(dtype)
    values[[3, 8, 11]] = values[0]  # ties
    known = np.zeros(20, bool)
    known[rng.choice(20, count, replace=False)] = True
    ordered = np.sort(values[known])
    for rank in range(count):
        assert nth_smallest(values, known, np.asarray(rank)) == ordered[rank]


def some_shot(dtype="float32", size=(5, 6)):
    rng = np.random.default_rng(0)
    rendered, truth = rng.uniform(1, 4, (2, *size)).astype(dtype)
    color = np.zeros((*size, 3), dtype)
    return Observation(
        Rendering(color, np.ones(size, dtype), rendered), color, None, truth
    )


@functools.partial(jax.jit, static_argnums=0)
def loss_and_slope(spec, shot):
    def value(rendered, alpha):
        rendering = shot.rendering._replace(depth=rendered, alpha=alpha)
        terms = depth.terms(spec, shot._replace(rendering=rendering))
        return weighted_sum(terms), values(terms)

    rendering = shot.rendering
    return jax.value_and_grad(value, argnums=(0, 1), has_aux=True)(
        rendering.depth, rendering.alpha
    )


@pytest.mark.hard_cases
@pytest.mark.parametrize(
    ("kind", "space"),
    [("metric", "depth"), ("affine", "disparity"), *full(("correlation", "disparity"))],
)
def test_what_is_unknown_or_see_through_teaches_nothing(kind, space, dtype):
    """0, NaN and infinity stand for unknown; a haze's expected depth is none."""
    spec = DepthSpec(kind, space, weight=0.3)
    shot = jax.tree.map(np.array, some_shot(dtype))
    valid = np.ones((5, 6), bool)
    valid[4] = False
    shot.depth[0] = [0.0, np.nan, np.inf, -1.0, 2.0, 2.0]
    rendered = shot.rendering.depth
    shot.rendering.alpha[0, 4:] = 0.4, 0.0
    rendered[4, 0], rendered[0, 5] = np.nan, 0.0
    masked = shot._replace(valid=valid)
    (value, metrics), grads = loss_and_slope(spec, masked)
    ours, truth = (
        np.asarray(x, np.float64)[1:4].ravel() for x in (rendered, masked.depth)
    )
    if space == "disparity":
        ours, truth = 1 / ours, 1 / truth
    expected = expected_loss(kind, ours, truth)
    tolerance = {"float32": 1e-5, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(value, 0.3 * expected, rtol=tolerance)
    np.testing.assert_allclose(metrics["error"], expected, rtol=tolerance)
    np.testing.assert_allclose(metrics["known"], 18 / 30, rtol=1e-6)
    grad, alpha_slope = (np.asarray(x) for x in grads)
    assert not grad[[0, 4]].any()
    assert grad[1:4].any()
    assert not alpha_slope.any()


def test_the_effect_reads_the_depths():
    regularizer, shot = DepthSpec("metric"), some_shot()
    assert regularizer.required_data == {"depths"}

    @jitted
    def loss(shot):
        context = PenaltyContext(None, None, None, None, observation=shot)
        return weighted_sum(regularizer.loss(None, context))

    error = np.abs(shot.rendering.depth - shot.depth).mean() / shot.depth.mean()
    np.testing.assert_allclose(loss(shot), 0.1 * error, rtol=1e-6)
    assert depth.terms(DepthSpec(), shot._replace(depth=None)) == {}
