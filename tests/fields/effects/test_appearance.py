"""Appearance codes: color reads them, density does not, and they learn."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.fields.field_ray import Ray
from nerfies_jax.fields.spec import SamplingSpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.scene import presets, scene
from nerfies_jax.scene import steps as field_steps
from nerfies_jax.scene.scene import RadianceScene
from nerfies_jax.training.effects import APPEARANCE, FrameCondition, Table, weighted_sum
from tests import gradients, random_params, scenes

TINY = RadianceScene(
    steps=10,
    rays=8,
    template=TemplateSpec(
        EncodingSpec(2), EncodingSpec(1), depth=1, width=8, skips=(), color_width=4
    ),
    sampling=SamplingSpec(5, 3, jitter=False),
    appearance=AppearanceSpec(width=3),
)
METADATA = SceneMetadata(
    near=1.0,
    far=3.0,
    center=(0.0, 0.0, 0.0),
    scale=1.0,
    background=None,
    times=(0.0, 1.0),
    exposures=((0, 0, 0.0), (1, 1, 0.0)),
)
# What has no bearing on the codes is small or gone: each of these compiles a step.
CHEAP = {
    "steps": 10,
    "rays": 4,
    "micro_batches": 1,
    "sampling": SamplingSpec(4, 3),
    "template": TINY.template,
    "coarse": None,
    "elastic": None,
    "background": None,
}


def ray(dtype):
    parts = [0.1, -0.2, 0.3], [0.6, 0.0, 0.8], 1.0, 3.0
    return Ray(*(jnp.asarray(part, dtype) for part in parts))


def condition(code):
    return FrameCondition(
        jnp.asarray(0.5, code.dtype), {"appearance": code}, jnp.int32(0)
    )


@functools.cache
def tracer():
    return jax.jit(scene.field(TINY, METADATA).render_ray)


def params_of(dtype):
    return random_params.like(scene.field(TINY, METADATA).init, dtype)


@pytest.mark.parametrize("table", ["appearance", "exposure"])
def test_the_condition_is_the_code_itself(table, rng):
    spec = AppearanceSpec(width=3, table=table)
    assert spec.tables == (Table(table, APPEARANCE, 3),)
    assert spec.features == 3
    code = jnp.asarray(rng.normal(size=3), jnp.float32)
    codes = {"exposure": code, "appearance": -code} | {table: code}
    read = spec.apply(None, None, condition(code)._replace(codes=codes))
    assert read is code


def test_codes_change_the_color_and_never_the_geometry(dtype):
    params = params_of(dtype)
    first, second = (
        tracer()(params, ray(dtype), condition(jnp.asarray([value] * 3, dtype)))
        for value in (0.0, 2.0)
    )
    for one, other in jax.tree.map(np.asarray, [*zip(first, second, strict=True)]):
        np.testing.assert_array_equal(one.static_weight, other.static_weight)
        np.testing.assert_array_equal(one.distances, other.distances)
        assert one.distance == other.distance
        # both levels read it; a reimplementation of NeRF-W leaves the coarse one out
        assert np.abs(one.color - other.color).max() > 1e-2


def test_color_has_the_code_s_slope(float64, rng):
    params = params_of("float64")
    pull = rng.normal(size=3)
    plain = dataclasses.replace(TINY, sampling=SamplingSpec(4, 0, jitter=False))
    render = scene.field(plain, METADATA).render_ray

    def shade(code):
        levels = render(params, ray("float64"), condition(code))
        return sum(jnp.sum(pull * level.color) for level in levels)

    assert gradients.directional_error(shade, rng.normal(size=3)) < 1e-8


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("nerf-w", marks=pytest.mark.full),
        pytest.param("nerfies", marks=pytest.mark.slow),
        pytest.param("hypernerf", marks=pytest.mark.slow),
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
    field = scene.field(spec, metadata)
    frames = evaluation.frames_of(capture, scene.build(spec, metadata).required_data)
    params = field.init(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1))
    batch = field_steps.draw_batch(frames, spec.rays, keys[0])

    def loss(codes):
        terms = field_steps.loss_terms(
            field,
            params | {"codes": codes},
            frames,
            batch,
            jnp.int32(0),
            keys[1],
        )
        return weighted_sum(terms)

    grads = jax.tree.map(np.asarray, jax.jit(jax.grad(loss))(params["codes"]))
    rows = np.unique(frames.appearance[batch.row])
    for name in {"appearance", "transient"} & set(grads):
        assert np.all(np.isfinite(grads[name]))
        assert np.all(np.any(grads[name][rows] != 0, axis=1)), name
        assert np.linalg.norm(grads[name]) > 1e-6
