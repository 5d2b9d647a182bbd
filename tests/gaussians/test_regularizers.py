"""Penalties against overfitting: opacity, scale, curvature of the rendered depth."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Params
from gaussians_jax.losses import point_depth, smooth_depth
from gaussians_jax.losses.opacity_scale import OpacityScaleSpec
from gaussians_jax.losses.point_depth import PointDepthSpec
from gaussians_jax.losses.smooth_depth import SmoothDepthSpec
from gaussians_jax.scene import scene
from nerfies_jax import evaluation
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from tests import scenes
from tests.gradients import directional_error


def test_opacity_and_scale_are_means_over_the_active(dtype):
    rng = np.random.default_rng(0)
    rows = splats.from_points(
        rng.normal(size=(5, 3)), rng.uniform(size=(5, 3)), degree=0
    )
    padded = splats.pad_rows(Params({"splats": rows}, {}), 8)
    padded = jax.tree.map(lambda leaf: leaf.astype(dtype), padded)
    metadata = scene.metadata_of(scenes.tiny_capture())
    zero, key = jnp.zeros((), jnp.int32), jax.random.key(0)
    context = PenaltyContext(FrameCondition(jnp.zeros(())), zero, key, padded)
    terms = OpacityScaleSpec(0.3, 0.2).bind(10, metadata).loss(padded, context)
    opacity = 1 / (1 + np.exp(-np.asarray(rows.opacity_logit, np.float64)))
    scale = np.exp(np.asarray(rows.log_scale, np.float64))
    np.testing.assert_allclose(terms["opacity"].value, opacity.mean(), rtol=1e-6)
    expected = scale.mean() / metadata.extent
    np.testing.assert_allclose(terms["scale"].value, expected, rtol=1e-6)
    assert (terms["opacity"].weight, terms["scale"].weight) == (0.3, 0.2)


curvature = jax.jit(smooth_depth.curvature)


def plane(dtype, slope=(0.01, -0.02)):
    """Depth of a plane, whose inverse is linear in the pixels, with one depth edge."""
    x, y = np.meshgrid(np.arange(9), np.arange(7))
    return jnp.asarray(1 / (0.8 + slope[0] * x + slope[1] * y), dtype)


def test_planes_have_no_curvature_and_steps_count_once_a_side(dtype):
    depth, alpha = plane(dtype), jnp.ones((7, 9), dtype)
    tight = 1e-6 if dtype == "float32" else 1e-14
    assert curvature(depth, alpha) < tight
    row = np.where(np.arange(9) < 4, 1.0, 2.0)
    stepped = jnp.asarray(np.tile(row, (7, 1)), dtype)
    # A step of 1/2 in inverse depth bends twice in each row.
    value = curvature(stepped, alpha)
    np.testing.assert_allclose(value, 2 * 0.5 * 7 / 63, rtol=1e-6)
    # Not across pixels whose depth means nothing.
    hidden = alpha.at[:, 3:5].set(0.2)
    stepped = stepped.at[:, 3].set(0.0)
    assert curvature(stepped, hidden) < tight
    grads = jax.jit(jax.grad(curvature, (0, 1)))(stepped, hidden)
    assert all(np.isfinite(grad).all() for grad in grads)


def test_the_slope_of_the_curvature_is_right(float64):
    rng = np.random.default_rng(1)
    depth = jnp.asarray(plane("float64") + 0.1 * rng.uniform(size=(7, 9)))
    assert (
        directional_error(lambda d: smooth_depth.curvature(d, jnp.ones_like(d)), depth)
        < 1e-6
    )


def wall(dtype):
    """A camera, the depth of a slanted wall in each pixel, and points on the wall."""
    camera = cameras.look_at((0.3, 0.2, -2), (0, 0, 0), (0, 1, 0), 20.0, (24, 18))
    camera = jax.tree.map(lambda leaf: np.asarray(leaf, dtype), camera)
    normal = np.array([0.5, 0.2, -1.0])  # the wall goes through the origin
    axes = np.asarray(camera.camera_from_world, np.float64)
    x, y = np.meshgrid(np.arange(24) + 0.5, np.arange(18) + 0.5)
    ray = np.stack([(x - 12) / 20, (y - 9) / 20, np.ones_like(x)], -1) @ axes
    position = np.asarray(camera.position, np.float64)
    depth = -(position @ normal) / (ray @ normal)
    rng = np.random.default_rng(2)
    pixel = rng.uniform(2, 15, (40, 2))
    at = np.stack([(pixel[:, 0] - 12) / 20, (pixel[:, 1] - 9) / 20, np.ones(40)], -1)
    at = at @ axes
    points = position + at * (-(position @ normal) / (at @ normal))[:, None]
    return camera, jnp.asarray(depth, dtype), jnp.asarray(points, dtype)


def test_points_on_a_wall_agree_with_its_depth(dtype):
    camera, depth, points = wall(dtype)
    alpha = jnp.ones_like(depth)
    errors = jax.jit(functools.partial(point_depth.relative_errors, camera, reach=0.05))
    error, known = errors(points, depth, alpha)
    assert known.all()
    assert error.max() < 2e-6  # the rotation is orthogonal to float32
    error, _ = errors(points, 1.02 * depth, alpha)
    np.testing.assert_allclose(error, 1 - 1 / 1.02, rtol=1e-4)
    # What hides the points, and points out of sight, are not pulled anywhere.
    hidden = jax.grad(lambda depth: errors(points, depth, alpha)[0].sum())
    assert not hidden(0.7 * depth).any()
    far = jnp.concatenate([points + jnp.asarray([9, 0, 0], dtype), -30 * points[:5]])
    assert not errors(far, depth, alpha)[1].any()
    assert not errors(points, depth, 0.1 * alpha)[1].any()


def test_the_slope_of_the_point_depth_is_right(float64):
    camera, depth, points = wall("float64")

    def error(scale):
        alpha = jnp.ones_like(depth)
        return point_depth.relative_errors(camera, points, scale, alpha, 0.5)[0].sum()

    scale = depth * np.random.default_rng(3).uniform(1.02, 1.1, depth.shape)
    assert directional_error(error, scale) < 1e-6


@pytest.mark.parametrize("weight", [-1.0, float("nan")])
def test_weights_are_checked(weight):
    for make in (SmoothDepthSpec, OpacityScaleSpec):
        with pytest.raises(ValueError, match="must be finite and not negative"):
            make(weight)
    with pytest.raises(ValueError, match="must be positive and finite"):
        PointDepthSpec(weight)


def test_a_step_renders_depth_only_for_a_penalty_that_reads_it():
    capture = scenes.tiny_capture()
    metadata, frames = scene.metadata_of(capture), evaluation.frames_of(capture)
    smooth = dataclasses.replace(scenes.TINY_SPLATS, smooth_depth=SmoothDepthSpec())
    points = dataclasses.replace(scenes.TINY_SPLATS, point_depth=PointDepthSpec())
    for spec, reads in ((scenes.TINY_SPLATS, False), (smooth, True), (points, True)):
        effects = scene.all_effects(spec, metadata)
        assert scene.draws_depth(effects, frames) == reads
