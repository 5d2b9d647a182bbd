"""Codes fitted to halves of frames that were never learnt from."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation, held_out_codes
from nerfies_jax import scene as nerf_scene
from nerfies_jax.effects.appearance import AppearanceSpec
from nerfies_jax.effects.warp import WarpSpec
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.radiance.template import TemplateSpec
from nerfies_jax.spec import RadianceScene, SamplingSpec
from nerfies_jax.training.model import TrainState
from tests import scenes

TINY_FIELD = RadianceScene(
    steps=10,
    template=TemplateSpec(
        EncodingSpec(2), EncodingSpec(1), depth=1, width=8, skips=(), colour_width=8
    ),
    sampling=SamplingSpec(4, 0),
    appearance=AppearanceSpec(width=3),
    warp=WarpSpec(position=EncodingSpec(2), depth=1, width=8, skips=()),
)


@pytest.fixture(scope="module")
def field():
    """A field whose warp and codes show, and a view of it."""
    capture = scenes.tiny_capture()
    metadata = nerf_scene.metadata_of(capture, TINY_FIELD)
    params = nerf_scene.field(TINY_FIELD, metadata).init(jax.random.key(3))
    params["warp"] = jax.tree.map(lambda leaf: leaf + 0.1, params["warp"])
    params["codes"] = jax.tree.map(lambda leaf: 40 * leaf, params["codes"])
    view = evaluation.view_of(capture, int(capture.heldout[0]))
    return metadata, params, view


def repainted(capture, field, rows):
    """The capture as the field itself would film it, in appearances it never learnt."""
    metadata, params, _ = field
    made = nerf_scene.field(TINY_FIELD, metadata)
    draw = jax.jit(made.render, static_argnums=4)
    step, pictures = jnp.asarray(10, jnp.int32), capture.images.copy()
    for row in rows:
        view = evaluation.view_of(capture, int(row))
        codes = made.codes_at(params, view)
        codes["appearance"] = jnp.asarray([3.0, -4.0, 2.0])
        colour = draw(params, view.camera, view.time, codes, capture.size, step).colour
        pictures[row] = evaluation.as_picture(np.asarray(colour))
    return dataclasses.replace(capture, images=pictures)


@pytest.mark.slow
def test_a_code_is_found_again_from_half_a_picture(field):
    metadata, params, _ = field
    capture = scenes.tiny_capture()
    rows = capture.heldout[:1]
    capture = repainted(capture, field, rows)
    state = TrainState(params, (), (), jnp.asarray(10, jnp.int32), jax.random.key(0))
    model = nerf_scene.build(TINY_FIELD, metadata)
    renderer = evaluation.Renderer(model, capture.size)
    before = evaluation.score_right_halves(
        capture, rows, evaluation.score(renderer, state, capture, rows).colour
    )
    found = held_out_codes.score(TINY_FIELD, metadata, state, capture, rows)
    assert before.psnr[0] < 35
    assert found.psnr[0] > 48  # the truth has 8 bits: 59 dB is all there is
    assert found.ssim[0] > 0.99


@pytest.mark.slow
def test_a_half_that_was_not_filmed_keeps_the_code_it_had(field):
    metadata, params, _ = field
    capture = scenes.tiny_capture()
    rows = capture.heldout[:1]
    valid = np.ones(capture.images.shape[:3], bool)
    valid[:, :, :20] = False
    capture = dataclasses.replace(repainted(capture, field, rows), valid=valid)
    state = TrainState(params, (), (), jnp.asarray(10, jnp.int32), jax.random.key(0))
    renderer = evaluation.Renderer(nerf_scene.build(TINY_FIELD, metadata), capture.size)
    colour = evaluation.score(renderer, state, capture, rows).colour
    before = evaluation.score_right_halves(capture, rows, colour)
    found = held_out_codes.score(TINY_FIELD, metadata, state, capture, rows)
    np.testing.assert_allclose(found.psnr, before.psnr, atol=1e-3)


def test_a_field_without_codes_has_none_to_fit(field):
    plain = dataclasses.replace(TINY_FIELD, appearance=None)
    capture, state = scenes.tiny_capture(), TrainState(field[1], (), (), None, None)
    found = held_out_codes.score(plain, field[0], state, capture, capture.heldout)
    assert found is None
