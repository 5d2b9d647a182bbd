"""Leaving the transient out of a trained NeRF-W leaves the static part as it is."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.fields.effects.transient import TransientSpec
from nerfies_jax.fields.field_ray import Ray
from nerfies_jax.fields.spec import SamplingSpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.scene import scene
from nerfies_jax.scene.scene import RadianceScene
from nerfies_jax.training.effects import FrameCondition
from tests import random_params, scenes

TINY = RadianceScene(
    steps=10,
    rays=16,
    template=TemplateSpec(
        EncodingSpec(2), EncodingSpec(1), depth=2, width=8, skips=(), color_width=4
    ),
    sampling=SamplingSpec(6, 4, jitter=False),
    appearance=AppearanceSpec(width=2),
    transient=TransientSpec(code_width=3, depth=1, width=8),
)


@functools.cache
def metadata():
    return scene.metadata_of(scenes.tiny_capture(), TINY)


@functools.cache
def tracer(*without):
    return jax.jit(scene.field(TINY, metadata(), without).render_ray)


def params_of(dtype):
    return random_params.like(scene.field(TINY, metadata()).init, dtype, 0.1, 2)


def ray_and_condition(dtype):
    parts = [0.1, 0.2, 2.0], [0.0, -0.28, -0.96], 1.0, 3.0
    ray = Ray(*(jnp.asarray(part, dtype) for part in parts))
    codes = {"appearance": [0.3, -0.2], "transient": [0.5, -1.0, 2.0]}
    codes = {name: jnp.asarray(code, dtype) for name, code in codes.items()}
    return ray, FrameCondition(jnp.asarray(0.4, dtype), codes, jnp.int32(0))


def test_with_it_the_ray_sees_both_through_one_transmittance(dtype):
    """Against a loop over the samples in Python floats (NeRF-W)."""
    params, (ray, condition) = params_of(dtype), ray_and_condition(dtype)
    (_, joint), (_, alone) = (
        jax.tree.map(np.asarray, tracer(*without)(params, ray, condition))
        for without in ((), ("transient",))
    )
    np.testing.assert_array_equal(joint.distances, alone.distances)
    distance = np.asarray(joint.distances, np.float64)
    end = max(float(ray.far) - distance[-1], 0)
    spacing = np.append(np.diff(distance), end)
    assert metadata().background is not None  # shines through the last sample
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
    assert np.abs(joint.color - alone.color).max() > 1e-2
    assert float(joint.distance) < float(alone.distance)  # it stands in front
