"""Appearance codes: colour reads them, density does not, and they learn."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation, presets, scene
from nerfies_jax.effects import appearance
from nerfies_jax.effects.appearance import AppearanceSpec
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.radiance.template import TemplateSpec
from nerfies_jax.render_ray import Ray
from nerfies_jax.scene import RadianceScene
from nerfies_jax.scene_metadata import SceneMetadata
from nerfies_jax.spec import SamplingSpec
from nerfies_jax.training.effects import APPEARANCE, FrameCondition, Table, weighted_sum
from tests import gradients, scenes

TINY = RadianceScene(
    steps=10,
    rays=8,
    template=TemplateSpec(
        EncodingSpec(2), EncodingSpec(1), depth=1, width=8, skips=(), colour_width=4
    ),
    sampling=SamplingSpec(5, 3, jitter=False),
    appearance=AppearanceSpec(width=3),
)
METADATA = SceneMetadata(
    near=1.0,
    far=3.0,
    centre=(0.0, 0.0, 0.0),
    scale=1.0,
    background=None,
    times=(0.0, 1.0),
    exposures=((0, 0, 0.0), (1, 1, 0.0)),
)
# What has no bearing on the codes is small or gone: each of these compiles a step.
CHEAP = {
    "steps": 10,
    "rays": 4,
    "sampling": SamplingSpec(4, 3),
    "template": TINY.template,
    "coarse": None,
    "elastic": None,
    "background": None,
}
WITH_CODES = sorted(
    name for name, spec in presets.PRESETS.items() if spec.appearance is not None
)


def ray(dtype):
    origin, direction = ([0.1, -0.2, 0.3], [0.6, 0.0, 0.8])
    near, far = jnp.asarray(1.0, dtype), jnp.asarray(3.0, dtype)
    return Ray(jnp.asarray(origin, dtype), jnp.asarray(direction, dtype), near, far)


def condition(code):
    return FrameCondition(
        jnp.asarray(0.5, code.dtype), {"appearance": code}, jnp.int32(0)
    )


@functools.cache
def tracer():
    return jax.jit(scene.field(TINY, METADATA).render_ray)


def params_of(dtype):
    params = scene.field(TINY, METADATA).init(jax.random.key(0))
    return jax.tree.map(lambda leaf: leaf.astype(dtype), params)


def test_the_condition_is_the_code_itself(dtype, rng):
    made = appearance.effect(AppearanceSpec(width=3))
    code = jnp.asarray(rng.normal(size=3), dtype)
    assert made.name == "appearance"
    assert made.tables == (Table("appearance", APPEARANCE, 3),)
    assert made.condition_width == 3
    found = made.condition(None, condition(code))
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, code)


@pytest.mark.full
def test_effects_may_share_a_named_table():
    made = appearance.effect(AppearanceSpec(width=3, table="exposure"))
    assert made.tables == (Table("exposure", APPEARANCE, 3),)
    codes = {"exposure": jnp.arange(3.0), "appearance": jnp.zeros(3)}
    found = made.condition(None, FrameCondition(jnp.asarray(0.0), codes, jnp.int32(0)))
    np.testing.assert_array_equal(found, np.arange(3.0))


@pytest.mark.parametrize("width", [0, -1])
def test_a_code_without_numbers_is_refused(width):
    with pytest.raises(ValueError, match=rf"width={width}.*set the effect to none"):
        AppearanceSpec(width=width)


def test_codes_change_the_colour_and_never_the_geometry(dtype):
    params = params_of(dtype)
    first, second = (
        tracer()(params, ray(dtype), condition(jnp.full(3, value, dtype)))
        for value in (0.0, 2.0)
    )
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.static_weight, other.static_weight)
        np.testing.assert_array_equal(one.distances, other.distances)
        assert one.distance == other.distance
        # both levels read it; a reimplementation of NeRF-W leaves the coarse one out
        assert np.abs(one.colour - other.colour).max() > 1e-2


def test_colour_has_the_code_s_slope(float64, rng):
    params = params_of(float64)
    pull = jnp.asarray(rng.normal(size=3))
    plain = dataclasses.replace(TINY, sampling=SamplingSpec(4, 0, jitter=False))
    render = scene.field(plain, METADATA).render_ray

    def shade(code):
        levels = render(params, ray(float64), condition(code))
        return sum(jnp.sum(pull * level.colour) for level in levels)

    code = jnp.asarray(rng.normal(size=3))
    assert gradients.directional_error(shade, code) < 1e-8
    assert np.all(np.abs(jax.grad(shade)(code)) > 1e-5)


@pytest.mark.full
def test_there_are_presets_with_codes():
    assert {"nerf-w", "nerf-w-small", "nerfies", "hypernerf"} <= set(WITH_CODES)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name, marks=pytest.mark.full if name == "nerf-w" else pytest.mark.slow
        )
        for name in WITH_CODES
    ],
)
def test_codes_of_every_preset_learn(name):
    """In the official Nerfies presets this gradient is exactly zero."""
    spec = dataclasses.replace(presets.PRESETS[name], **CHEAP)
    if spec.warp is not None:
        warp = dataclasses.replace(spec.warp, depth=1, width=8, skips=())
        spec = dataclasses.replace(spec, warp=warp)
    capture = scenes.tiny_capture()
    metadata = scene.metadata_of(capture, spec)
    made = scene.field(spec, metadata)
    frames = evaluation.frames_of(capture, scene.build(spec, metadata).required_data)
    params = made.init(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1))
    batch = scene.draw_batch(frames, spec.rays, keys[0])

    def loss(codes):
        terms = scene.loss_terms(
            made,
            params | {"codes": params["codes"] | {"appearance": codes}},
            frames,
            batch,
            jnp.int32(0),
            keys[1],
        )
        return weighted_sum(terms)

    grad = jax.jit(jax.grad(loss))(params["codes"]["appearance"])
    assert np.all(np.isfinite(grad))
    rows = np.unique(frames.appearance[batch.row])
    assert np.all(np.any(grad[rows] != 0, axis=1)), grad
    assert np.linalg.norm(grad) > 1e-6
