"""Footprints against the textbook covariance, and its hard cases."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core.splats import Gaussians
from gaussians_jax.splatting import projection
from gaussians_jax.splatting.raster_spec import GSPLAT
from nerfies_jax.geometry.camera import Camera
from tests import gradients
from tests.gaussians.shared import finite, jitted, put
from tests.oracles import dense_splats

SIZE = (64, 48)
SHARP = dataclasses.replace(GSPLAT, antialiased=True)
project = jitted(projection.project, static_argnums=(2, 3))


def camera_at(position, dtype, turn=0.3, skew=2.0, focal=60.0):
    rotation = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    fields = (rotation, position, focal, [29.0, 27.0], skew, 1.2, [0.0] * 3, [0.0] * 2)
    return put(Camera(*fields), dtype)


def some_gaussians(rng, count, dtype):
    fields = (
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.normal(-1.5, 1.0, (count, 3))),
        rng.uniform(0.05, 0.95, count),
    )
    return put(Gaussians(*fields), dtype)


def covariance_of(whitening):
    """[[a, b], [b, c]] in float64 from p, k, r."""
    p, k, r = np.asarray(whitening, np.float64).T
    a = 1 / (2 * p * p)
    return np.stack([a, k * a, k * a, 1 / (2 * r * r) + k * k * a], -1).reshape(
        -1, 2, 2
    )


def one(dtype, mean=(0, 0, 2), quaternion=(1, 0, 0, 0), scale=(0.1,) * 3, opacity=0.5):
    fields = ([mean], [quaternion], [scale], [opacity])
    return Gaussians(*(np.asarray(x, dtype) for x in fields))


@functools.partial(jitted, static_argnums=2)
def textbook(gaussians, camera, spec):
    mean_px, covariance, depth = jax.vmap(
        lambda m, q, s: dense_splats.footprint(m, q, s, camera, SIZE, spec)
    )(gaussians.mean, gaussians.quaternion, gaussians.scale)
    opacity, _ = jax.vmap(lambda c, o: dense_splats.opacities_and_conics(c, o, spec))(
        covariance, gaussians.opacity
    )
    return mean_px, covariance, depth, opacity


@pytest.mark.parametrize("spec", [GSPLAT, SHARP], ids=["plain", "antialiased"])
def test_footprints_equal_the_textbook_with_skew_aspect_and_offset(spec, dtype, rng):
    gaussians = some_gaussians(rng, 300, dtype)
    camera = camera_at([0.2, 0.1, -2.0], dtype)
    footprint = project(gaussians, camera, SIZE, spec)
    assert all(leaf.dtype == dtype for leaf in footprint)
    with jax.enable_x64(True):
        exact, exact_camera = put((gaussians, camera), "float64")
        mean_px, covariance, depth, opacity = textbook(exact, exact_camera, spec)
    rendered = (depth > 0.02) & (opacity > 1.01 / 255)
    assert np.asarray(footprint.extent_px)[rendered].all()
    dilated = covariance + spec.eps2d * np.eye(2)
    size = np.trace(dilated, axis1=1, axis2=2)[:, None, None]
    # Relative: depths down to 0.02 magnify the rounding of x - c in float32.
    tolerance = {"float32": 2e-4, "float64": 1e-12}[dtype]
    error = np.abs(covariance_of(footprint.whitening) - dilated) / size
    assert error[rendered].max() < tolerance
    shift = np.abs(footprint.mean_px - mean_px) / (np.abs(mean_px) + 1)
    assert shift[rendered].max() < tolerance
    np.testing.assert_allclose(
        footprint.opacity[rendered], opacity[rendered], rtol=tolerance
    )
    ln = 2 * np.log(opacity * 255)[:, None]
    box = np.sqrt(np.maximum(ln, 0) * np.stack([dilated[:, 0, 0], dilated[:, 1, 1]], 1))
    np.testing.assert_allclose(
        footprint.extent_px[rendered], box[rendered], rtol=50 * tolerance
    )


def test_projection_gradient_equals_central_differences(float64, rng):
    gaussians = some_gaussians(rng, 6, float64)
    camera = camera_at([0.2, 0.1, -4.0], float64)
    weights = rng.normal(size=(6, 7))

    def loss(gaussians, camera):
        footprint = projection.project(gaussians, camera, SIZE, SHARP)
        fields = (footprint.mean_px, footprint.whitening, footprint.opacity[:, None])
        return jnp.sum(
            jnp.concatenate([*fields, footprint.depth[:, None]], 1) * weights
        )

    assert gradients.directional_error(loss, gaussians, camera) < 1e-7


ROWS = 20  # projected at once, in one program for all tests that need one


def projected(gaussians, camera):
    """Up to `ROWS` footprints, as NumPy arrays; the first is repeated to fill up."""
    count = len(gaussians.opacity)
    rows = np.minimum(np.arange(ROWS), count - 1)
    filled = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], gaussians)
    footprint = project(filled, camera, SIZE, GSPLAT)
    return jax.tree.map(lambda leaf: leaf[:count], footprint)


HOPELESS = {
    "z zero": dict(mean=(0.1, 0.1, 0.0)),
    "z 1e-30": dict(mean=(0.1, 0.1, 1e-30)),
    "z -1e-30": dict(mean=(0.1, 0.1, -1e-30)),
    "z 1e-6": dict(mean=(0.1, 0.1, 1e-6)),
    "behind": dict(mean=(0.1, 0.1, -1.0)),
    "beyond far": dict(mean=(0.0, 0.0, 1e11)),
    "nan mean": dict(mean=(float("nan"), 0.0, 2.0)),
    "nan depth": dict(mean=(0.0, 0.0, float("nan"))),
    "infinite mean": dict(mean=(float("inf"), 0.0, 2.0)),
    "zero quaternion": dict(quaternion=(0, 0, 0, 0)),
    "nan quaternion": dict(quaternion=(1, float("nan"), 0, 0)),
    "infinite scale": dict(scale=(float("inf"), 1, 1)),
    "scale beyond MAX_EXTENT_PX": dict(scale=(1e18, 1, 1)),
    "nan opacity": dict(opacity=float("nan")),
    "faint": dict(opacity=0.003915),  # between 1/256 and 1/255, where it is cut
}


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", HOPELESS)
def test_what_cannot_be_drawn_is_finite_without_gradient(name, dtype):
    gaussians = one(dtype, **HOPELESS[name])
    camera = camera_at([0.0, 0.0, 0.0], dtype, turn=0.0)
    (footprint, visible), _, grads = footprint_and_slopes(gaussians, camera)
    assert not visible[0]
    assert finite(footprint)
    assert not any(leaf.any() for leaf in grads)


DRAWABLE = {
    "just inside near": dict(mean=(0.0, 0.0, 0.010001)),
    "far to the side": dict(mean=(1e20, 0.0, 2.0)),
    "huge": dict(scale=(1e8, 1e8, 1e8)),
    "flat and edge-on": dict(scale=(0.0, 1.0, 1.0)),
    "a point": dict(scale=(0.0, 0.0, 0.0)),
    "tiny quaternion": dict(quaternion=(1e-25, 0, 0, 1e-25)),
    "long quaternion": dict(quaternion=(3e38, 0, 0, 3e38)),
    "opaque": dict(opacity=1.0),
    "barely there": dict(opacity=0.00393),  # between 1/255 and 1/254
}


@pytest.mark.hard_cases
@pytest.mark.parametrize("name", DRAWABLE)
def test_extreme_but_valid_gaussians_are_drawn_with_finite_gradient(name, dtype):
    gaussians = one(dtype, **DRAWABLE[name])
    camera = camera_at([0.0, 0.0, 0.0], dtype, turn=0.0)
    (footprint, visible), _, grads = footprint_and_slopes(gaussians, camera)
    assert visible[0]
    assert finite((footprint, grads))


@jitted
def footprint_and_slopes(gaussians, camera):
    """Plain footprint with its visibility, antialiased one with its slopes."""

    def loss(gaussians):
        footprint = projection.project(gaussians, camera, SIZE, SHARP)
        total = jnp.sum(footprint.mean_px) + jnp.sum(footprint.whitening)
        return total + jnp.sum(footprint.opacity + footprint.depth), footprint

    grads, sharp = jax.grad(loss, has_aux=True)(gaussians)
    # The antialiased factor may hide a small one: visibility is that of the plain form.
    plain = projection.project(gaussians, camera, SIZE, GSPLAT)
    return (plain, plain.visible), sharp, grads


def test_what_lies_beside_the_image_is_visible_and_not_seen(rng):
    """Density control divides by the views in which a Gaussian was."""
    gaussians = some_gaussians(rng, 300, "float32")
    footprints, visible, seen = footprints_seen(
        gaussians, camera_at([0.0, 0.0, -3.0], "float32")
    )
    places, reaches = np.asarray(footprints.mean_px), np.asarray(footprints.extent_px)
    expected = [
        x + right > 0 and x - right < 64 and y + down > 0 and y - down < 48
        for (x, y), (right, down) in zip(places, reaches, strict=True)
    ]
    np.testing.assert_array_equal(seen, visible & expected)
    assert 10 < seen.sum() < visible.sum() - 10


@jitted
def footprints_seen(gaussians, camera):
    footprints = projection.project(gaussians, camera, SIZE, GSPLAT)
    return footprints, footprints.visible, footprints.overlaps_image(SIZE)


@pytest.mark.hard_cases
def test_edge_on_disc_keeps_the_least_compensation(dtype):
    gaussians = one(dtype, scale=(0.0, 1.0, 1.0), opacity=1.0)
    camera = camera_at([0.0, 0.0, 0.0], dtype, turn=0.0)
    _, footprint, _ = footprint_and_slopes(gaussians, camera)
    np.testing.assert_allclose(footprint.opacity, [0.005], rtol=1e-6)
