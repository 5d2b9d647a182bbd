"""Leaving the transient out of a trained NeRF-W leaves the static part as it is."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation, scene
from nerfies_jax.effects.appearance import AppearanceSpec
from nerfies_jax.effects.transient import TransientSpec
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.radiance.template import TemplateSpec
from nerfies_jax.render_ray import Ray
from nerfies_jax.scene import RadianceScene
from nerfies_jax.spec import SamplingSpec
from nerfies_jax.training.effects import FrameCondition
from tests import scenes

TINY = RadianceScene(
    steps=10,
    rays=16,
    template=TemplateSpec(
        EncodingSpec(2), EncodingSpec(1), depth=2, width=8, skips=(), colour_width=4
    ),
    sampling=SamplingSpec(6, 4, jitter=False),
    appearance=AppearanceSpec(width=2),
    transient=TransientSpec(code_width=3, depth=1, width=8),
)
# softplus(-1e4) is zero in both precisions: a medium that is nowhere.
NOWHERE = -1e4


@functools.cache
def metadata():
    return scene.metadata_of(scenes.tiny_capture(), TINY)


@functools.cache
def tracer(spec, without=()):
    return jax.jit(scene.field(spec, metadata(), without).render_ray)


def params_of(dtype):
    """Drawn by NumPy: there is nothing to compile."""
    shapes = jax.eval_shape(scene.field(TINY, metadata()).init, jax.random.key(2))
    rng = np.random.default_rng(2)

    def draw(leaf):
        return jnp.asarray(rng.normal(size=leaf.shape) / leaf.shape[0] ** 0.5, dtype)

    return jax.tree.map(draw, shapes)


def emptied(params):
    """The same field with a transient of no density."""
    net = params["transient"]
    head = net.heads["density"]
    gone = head._replace(
        weight=np.zeros(head.weight.shape, head.weight.dtype),
        bias=np.full(head.bias.shape, NOWHERE, head.bias.dtype),
    )
    return params | {"transient": net._replace(heads=net.heads | {"density": gone})}


def ray_and_condition(dtype):
    ray = Ray(
        jnp.asarray([0.1, 0.2, 2.0], dtype),
        jnp.asarray([0.0, -0.28, -0.96], dtype),
        jnp.asarray(1.0, dtype),
        jnp.asarray(3.0, dtype),
    )
    codes = {
        "appearance": jnp.asarray([0.3, -0.2], dtype),
        "transient": jnp.asarray([0.5, -1.0, 2.0], dtype),
    }
    return ray, FrameCondition(jnp.asarray(0.4, dtype), codes, jnp.int32(0))


def test_left_out_it_is_a_transient_of_no_density(dtype):
    params, (ray, condition) = params_of(dtype), ray_and_condition(dtype)
    coarse, left_out = tracer(TINY, ("transient",))(params, ray, condition)
    same_coarse, empty = tracer(TINY)(emptied(params), ray, condition)
    empty = jax.tree.map(np.asarray, empty)
    # Two programs: the last bits of a product may differ.
    tolerance = {"float32": 1e-6, "float64": 1e-14}[dtype]
    assert np.all(empty.media_weight["transient"] == 0)
    assert left_out.media == {}
    assert left_out.beta is None
    for name in ("colour", "alpha", "distance", "static_weight", "distances"):
        one, other = getattr(left_out, name), getattr(empty, name)
        np.testing.assert_allclose(one, other, atol=tolerance, err_msg=name)
    np.testing.assert_allclose(coarse.colour, same_coarse.colour, atol=tolerance)
    np.testing.assert_allclose(empty.beta, TINY.transient.beta_min, rtol=tolerance)


@pytest.mark.full
def test_left_out_it_is_the_field_that_never_had_one(dtype):
    params, (ray, condition) = params_of(dtype), ray_and_condition(dtype)
    never = dataclasses.replace(TINY, transient=None)
    _, left_out = tracer(TINY, ("transient",))(params, ray, condition)
    _, plain = tracer(never)(params, ray, condition)
    np.testing.assert_array_equal(left_out.colour, plain.colour)
    np.testing.assert_array_equal(left_out.static_weight, plain.static_weight)


def test_with_it_the_ray_sees_both_through_one_transmittance(dtype):
    """Against a loop over the samples in Python floats (NeRF-W, section 4.2)."""
    params, (ray, condition) = params_of(dtype), ray_and_condition(dtype)
    _, joint = tracer(TINY)(params, ray, condition)
    _, alone = tracer(TINY, ("transient",))(params, ray, condition)
    np.testing.assert_array_equal(joint.distances, alone.distances)
    distance = np.asarray(joint.distances, np.float64)
    end = max(float(ray.far) - distance[-1], 0)
    spacing = np.append(np.diff(distance), end)
    if metadata().background is None:
        pytest.fail("this test has the background shine through the last sample")
    static = np.asarray(alone.static_weight, np.float64)
    medium = jax.tree.map(
        lambda leaf: np.asarray(leaf, np.float64), joint.media["transient"]
    )
    # The static opacities, out of the weights it has when alone.
    passing, opacity = 1.0, []
    for weight in static:
        opacity.append(weight / passing)
        passing -= weight
    passing, beta = 1.0, TINY.transient.beta_min
    weights, others = [], []
    for i, density in enumerate(medium.density):
        own = 1 - np.exp(-density * spacing[i])
        weights.append(passing * opacity[i])
        others.append(passing * own)
        beta += passing * own * medium.beta[i]
        passing *= (1 - opacity[i]) * (1 - own)
    tolerance = {"float32": 3e-6, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(joint.static_weight, weights, atol=tolerance)
    np.testing.assert_allclose(joint.media_weight["transient"], others, atol=tolerance)
    np.testing.assert_allclose(joint.beta, beta, rtol=tolerance)
    assert np.abs(joint.colour - alone.colour).max() > 1e-2
    assert float(joint.distance) < float(alone.distance)  # it stands in front


@pytest.mark.slow
def test_a_step_trains_the_transient_its_codes_and_the_trunk():
    capture = scenes.tiny_capture()
    model = scene.build(TINY, metadata())
    state = model.init(capture, jax.random.key(3))
    frames = evaluation.frames_of(capture, model.required_data)
    after, metrics = jax.jit(model.step)(state, frames)
    assert {"colour", "fine", "coarse", "transient/density"} <= set(metrics)
    changed = jax.tree.map(
        lambda one, other: bool(np.any(one != other)), state.params, after.params
    )
    assert changed["codes"] == {"appearance": True, "transient": True}
    assert all(jax.tree.leaves(changed["transient"]))
    assert all(jax.tree.leaves(changed["template"]["fine"]))
