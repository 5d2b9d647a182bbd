"""Whole steps of every radiance field, from starts that nobody would choose."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import scene
from nerfies_jax.effects import scene_flow_losses as flow_losses
from tests import scenes
from tests.hard_cases import tiny_fields

pytestmark = pytest.mark.hard_cases


# --- what the field knows of a hostile capture ---------------------------------------


def scaled(capture, factor):
    """The same film in other units."""
    points = capture.points._replace(
        position=(capture.points.position * factor).astype(np.float32)
    )
    cameras = capture.cameras._replace(
        position=(capture.cameras.position * factor).astype(np.float32)
    )
    return dataclasses.replace(
        capture,
        points=points,
        cameras=cameras,
        depths=(capture.depths * factor).astype(np.float32),
        near=capture.near * factor,
        far=capture.far * factor,
    )


@pytest.mark.parametrize("factor", [1e-12, 1e-6, 1e6, 1e12])
def test_units_of_a_capture_do_not_reach_the_field(factor):
    spec = tiny_fields.tiny("nerf")
    capture = scenes.tiny_capture()
    usual = scene.facts_of(capture, spec)
    other = scene.facts_of(scaled(capture, factor), spec)
    # To the rounding of float32 points and cameras
    np.testing.assert_allclose(other.scale * factor, usual.scale, rtol=1e-6)
    np.testing.assert_allclose(other.near / factor, usual.near, rtol=1e-6)
    np.testing.assert_allclose(other.far / factor, usual.far, rtol=1e-6)
    centre = np.asarray(other.centre) / factor
    np.testing.assert_allclose(centre, usual.centre, atol=1e-6)


def test_points_behind_the_far_plane_do_not_push_the_near_one_past_it():
    spec = tiny_fields.tiny("nerf")
    capture = scenes.tiny_capture()
    ahead = 50 * capture.cameras.camera_from_world[0, 2]
    points = capture.points._replace(position=capture.points.position + ahead)
    facts = scene.facts_of(dataclasses.replace(capture, points=points), spec)
    assert facts.near == capture.near
    assert facts.far == capture.far


def test_a_scene_without_width_in_float64_is_refused():
    capture = scenes.tiny_capture()
    cameras = capture.cameras
    away = cameras._replace(position=np.full_like(cameras.position, 1e30))
    away = dataclasses.replace(capture, cameras=away, points=None)
    with pytest.raises(ValueError, match=r"no width; move the scene"):
        scene.facts_of(away, tiny_fields.tiny("nerf"))


# --- means of what is hardly there ---------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e-18, 1e-22, 2e-30, 1e18])
def test_a_weighted_mean_keeps_its_slopes_however_small_the_weights(scale, rng, dtype):
    values = rng.normal(size=(5, 4, 3))
    share = rng.uniform(0.1, 1.0, (5, 4))

    def mean(values, logs):
        # as `visible` is made: the weight's own slope is the weight
        return flow_losses.weighted_mean(values, jnp.asarray(scale) * jnp.exp(logs))

    given = jnp.asarray(values, dtype), jnp.log(jnp.asarray(share, dtype))
    value, slopes = jax.jit(jax.value_and_grad(mean, (0, 1)))(*given)
    of_axes = values.mean(-1)
    exact = (share * of_axes).sum() / share.sum()
    by_log = share * (of_axes - exact) / share.sum()
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(value, exact, atol=tolerance)
    np.testing.assert_allclose(slopes[1], by_log, atol=tolerance)
    by_value = np.broadcast_to((share / share.sum() / 3)[..., None], values.shape)
    np.testing.assert_allclose(slopes[0], by_value, atol=tolerance)


@pytest.mark.parametrize("scale", [0.0, 1e-31, 1e-37])
def test_weights_that_are_next_to_nothing_are_none(scale, dtype):
    def mean(values, weight):
        return flow_losses.weighted_mean(values, weight)

    given = jnp.ones((4, 3), dtype), jnp.full((4,), scale, dtype)
    value, slopes = jax.value_and_grad(mean, (0, 1))(*given)
    assert value == 0
    assert not any(np.any(slope) for slope in slopes)
