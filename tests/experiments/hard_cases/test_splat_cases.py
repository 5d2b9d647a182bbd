"""Gaussians at their hard points, at the edges of what is drawn, in half precision."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.hard_cases import footprints as hard_footprints
from experiments.hard_cases import splats as hard_splats
from gaussians_jax.core import splats
from gaussians_jax.core.splats import Gaussians
from gaussians_jax.splatting import projection, raster
from gaussians_jax.splatting.projection import Footprints
from gaussians_jax.splatting.raster_spec import GSPLAT, INRIA
from nerfies_jax.geometry.camera import Camera
from tests.experiments.hard_cases import checks

CASES = hard_footprints.CASES + hard_splats.CASES
SIZE = (64, 48)
QUICK = dataclasses.replace(GSPLAT, tile=4, batch=1, chunk=1)
# One for what is projected and two for what is drawn: each is a program.
NEARBY = dataclasses.replace(GSPLAT, far=1e3)
ONE_PIXEL = dataclasses.replace(QUICK, transmittance_threshold=1e-3)
THROUGH = dataclasses.replace(INRIA, tile=4, batch=1, chunk=1)

pytestmark = pytest.mark.hard_cases
test_held = checks.by_case(CASES)


def camera(dtype):
    fields = (np.eye(3), [0.0] * 3, 64.0, [32.0, 24.0], 0.0, 1.0, [0.0] * 3, [0.0] * 2)
    return Camera(*(np.asarray(x, jnp.dtype(dtype)) for x in fields))


def one(dtype, mean=(0, 0, 2), opacity=0.5):
    fields = ([mean], [[1, 0, 0, 0]], [[0.1] * 3], [opacity])
    return Gaussians(*(np.asarray(x, jnp.dtype(dtype)) for x in fields))


def neighbors(value, dtype):
    """That number in that precision, and the next ones below and above."""
    exact = np.dtype(dtype).type(value)
    return [np.nextafter(exact, -np.inf), exact, np.nextafter(exact, np.inf)]


@jax.jit
def seen_and_slopes(gaussians, view):
    def loss(gaussians):
        footprint = projection.project(gaussians, view, SIZE, NEARBY)
        total = jnp.sum(footprint.mean_px) + jnp.sum(footprint.whitening)
        return total + jnp.sum(footprint.opacity + footprint.depth), footprint

    slopes, footprint = jax.grad(loss, has_aux=True)(gaussians)
    return footprint, slopes


@pytest.mark.parametrize(
    ("what", "edge", "rendered"),
    [
        ("near", NEARBY.near, [False, True, True]),
        ("far", NEARBY.far, [True, True, False]),
        ("opacity", NEARBY.alpha_threshold, [False, True, True]),
    ],
)
def test_what_is_drawn_ends_within_one_step_of_its_edge(what, edge, rendered, dtype):
    for value, expected in zip(neighbors(edge, dtype), rendered, strict=True):
        place = {"opacity": value} if what == "opacity" else {"mean": (0, 0, value)}
        footprint, slopes = seen_and_slopes(one(dtype, **place), camera(dtype))
        assert bool(footprint.visible[0]) is expected
        for leaf in (*footprint, *slopes):
            assert np.isfinite(leaf).all()
        if not expected:
            assert not any(np.any(leaf) for leaf in slopes)


@pytest.mark.parametrize("side", [-1, 1])
def test_the_clamped_tangent_is_continuous_and_its_slope_is_the_clamped_one(
    side, dtype
):
    """At x/z of half an image and 0.3 beyond: J alone stops there, the mean goes on."""
    limit = side * (32 + 0.3 * 32) / 64
    places = []
    for share in (1 - 1e-4, 1 + 1e-4, 2.0):
        gaussians = one(dtype, mean=(2 * limit * share, 0, 2))
        footprint, slopes = jax.tree.map(
            np.asarray, seen_and_slopes(gaussians, camera(dtype))
        )
        places.append((footprint, slopes.mean[0, 0], share))
    inside, outside, beyond = places
    for field, tolerance in (("mean_px", 1e-2), ("whitening", 1e-4)):
        a, b = (getattr(pair[0], field) for pair in (inside, outside))
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance)
    # Outside, p, k and r no longer move with x: the slope is that of the mean alone.
    for _, slope, share in (outside, beyond):
        assert abs(slope - 32) < {"float32": 1e-4, "float64": 1e-12}[dtype], share
    assert abs(inside[1] - 32) > 1e-2
    np.testing.assert_allclose(
        beyond[0].whitening, outside[0].whitening, rtol=2e-5, atol=0
    )
    assert abs(beyond[0].mean_px[0, 0] - (32 + 128 * limit)) < 1e-3


def pixel(alphas, values, spec):
    """Composite at the only pixel of an image, Gaussians too wide to fall off."""
    count, dtype = alphas.shape[0], alphas.dtype
    footprints = Footprints(
        mean_px=jnp.full((count, 2), 0.5, dtype),
        whitening=jnp.tile(jnp.asarray([1e-3, 0, 1e-3], dtype), (count, 1)),
        opacity=alphas,
        depth=jnp.arange(1, count + 1).astype(dtype),
        extent_px=jnp.full((count, 2), 2, dtype),
    )
    image, left = raster.rasterize(footprints, values[:, None], (1, 1), spec)
    return image[0, 0, 0], left[0, 0]


def pixel_and_slopes(alphas, values, spec):
    """Color and what is left, and slopes in `alphas` and `values`; one or two rows."""
    hidden = (0, max(0, 2 - len(alphas)))  # what is not drawn behind a single one
    rendered, slopes = _pixel_and_slopes(
        np.pad(alphas, hidden), np.pad(values, hidden), spec
    )
    return rendered, [np.asarray(slope)[: len(alphas)] for slope in slopes]


@functools.partial(jax.jit, static_argnums=2)
def _pixel_and_slopes(alphas, values, spec):
    def loss(alphas, values):
        color, left = pixel(alphas, values, spec)
        return color + left / 2, (color, left)

    slopes, rendered = jax.grad(loss, (0, 1), has_aux=True)(alphas, values)
    return rendered, slopes


def test_an_alpha_jumps_at_the_cut_and_nowhere_else(dtype):
    """exp(log o) is an ulp or two off, so the cut is approached to eight ulps."""
    ulps = 8 * float(jnp.finfo(dtype).eps)
    values = np.asarray([1.0], dtype)
    for share, rendered in ((1 - ulps, False), (1 + ulps, True)):
        alpha = np.asarray([share / 255], dtype)
        (color, left), (slope, _) = pixel_and_slopes(alpha, values, ONE_PIXEL)
        expected = float(alpha[0]) if rendered else 0
        assert abs(color - expected) <= ulps / 255
        assert abs(left - (1 - expected)) <= ulps
        assert abs(slope[0] - (0.5 if rendered else 0)) < 4 * ulps


@pytest.mark.parametrize(
    "spec",
    [
        pytest.param(ONE_PIXEL, id="zero"),
        pytest.param(THROUGH, id="through", marks=pytest.mark.full),
    ],
)
def test_an_alpha_stays_at_its_clamp_and_one_is_finite(spec, dtype):
    ulps = 8 * float(jnp.finfo(dtype).eps)
    values = np.asarray([1.0, 0.25], dtype)
    through = spec.clamp_gradient == "through"
    for alpha in (0.99 * (1 - ulps), 0.99 * (1 + ulps), 1 - ulps, 1.0):
        alphas = np.asarray([alpha, 0.5], dtype)
        (color, left), slopes = pixel_and_slopes(alphas, values, spec)
        rendered = min(alpha, 0.99)
        assert abs(color - (rendered + (1 - rendered) / 8)) < 4 * ulps
        assert abs(left - (1 - rendered) / 2) < 4 * ulps
        # 1 - 0.25/2 - 1/4 of what lies behind
        expected = 0.625 if through or alpha < 0.99 else 0
        # What lies behind is divided by 1 - alpha = 0.01.
        assert abs(slopes[0][0] - expected) < 200 * ulps
        assert np.isfinite(slopes).all()


def test_a_pixel_is_done_on_the_side_of_the_stop_its_transmittance_is_on(dtype):
    """T = 0.01 (1 - a): the Gaussian that would take it to the stop is left out."""
    ulps = 64 * float(jnp.finfo(dtype).eps)
    values = np.asarray([0.0, 1.0], dtype)
    for share, rendered in ((1 + ulps, True), (1 - ulps, False)):
        # 0.98 * 0.98 stay clear of the clamp: (1 - 0.98) (1 - a) = stop * share.
        alpha = 1 - ONE_PIXEL.transmittance_threshold * share / 0.02
        alphas = np.asarray([0.98, alpha], dtype)
        (color, left), slopes = pixel_and_slopes(alphas, values, ONE_PIXEL)
        assert abs(color - (0.02 * alpha if rendered else 0)) < ulps
        assert abs(left - (1e-3 if rendered else 0.02)) < ulps
        assert bool(slopes[0][1] != 0) is rendered


@pytest.mark.parametrize("kind", ["bfloat16", "float16"])
def test_half_precision_gaussians_are_refused_by_name(kind):
    """Eight bits place a pixel to 1 px at 256; Adam's steps do not move such means."""
    with pytest.raises(ValueError, match=f"{kind}.*float32"):
        projection.project(*jax.device_put((one(kind), camera(kind))), SIZE, GSPLAT)
    shapes = (1, 2), (1, 3), (1,), (1,), (1, 2)
    half = jax.device_put(Footprints(*(np.ones(x, jnp.dtype(kind)) for x in shapes)))
    with pytest.raises(ValueError, match=f"{kind}.*float32"):
        raster.rasterize(half, half.whitening, SIZE, GSPLAT)
    with pytest.raises(ValueError, match=f"{kind}.*float32"):
        splats.from_points(np.eye(3), np.eye(3), dtype=jnp.dtype(kind))
