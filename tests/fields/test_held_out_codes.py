"""Codes fitted to halves of frames that were never learned from."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.scene import held_out_codes
from nerfies_jax.scene import scene as nerf_scene
from nerfies_jax.training.model import TrainState
from tests import scenes
from tests.fields.test_skipping import GUIDED, ORANGE, full_of_holes
from tests.scenes import TINY_FIELD


def repainted(rows):
    """The capture as the field would render it, in appearances it never learned."""
    capture, (metadata, params, _) = scenes.tiny_capture(), scenes.tiny_field()
    field = nerf_scene.field(TINY_FIELD, metadata)
    draw = jax.jit(field.render, static_argnums=4)
    step, images = jnp.asarray(10, jnp.int32), capture.images.copy()
    for row in rows:
        view = evaluation.view_of(capture, int(row))
        codes = field.codes_at(params, view)
        codes["appearance"] = jnp.asarray([3.0, -4.0, 2.0])
        color = draw(params, view.camera, view.time, codes, capture.size, step).color
        images[row] = evaluation.to_uint8(np.asarray(color))
    return dataclasses.replace(capture, images=images)


@pytest.mark.slow
def test_a_code_is_found_again_from_half_an_image_if_that_was_observed():
    metadata, params, _ = scenes.tiny_field()
    rows = scenes.tiny_capture().heldout[:1]
    painted = repainted(rows)
    state = TrainState(params, (), (), jnp.asarray(10, jnp.int32), jax.random.key(0))
    renderer = evaluation.Renderer(nerf_scene.build(TINY_FIELD, metadata), painted.size)

    score = held_out_codes.scorer(TINY_FIELD, metadata, painted.size)

    def before_and_after(capture):
        color = evaluation.score(renderer, state, capture, rows).color
        return (
            evaluation.score_right_halves(capture, rows, color),
            score(state, capture, rows),
        )

    before, after = before_and_after(painted)
    assert before.psnr[0] < 35
    assert after.psnr[0] > 48  # the truth has 8 bits: 59 dB is all there is
    assert after.ssim[0] > 0.99
    valid = np.ones(painted.images.shape[:3], bool)
    valid[:, :, :20] = False
    before, after = before_and_after(dataclasses.replace(painted, valid=valid))
    np.testing.assert_allclose(after.psnr, before.psnr, atol=1e-3)


@pytest.mark.slow
def test_codes_are_fitted_to_the_samples_that_an_image_is_made_of():
    spec = dataclasses.replace(GUIDED, appearance=AppearanceSpec(2))
    model, params = full_of_holes(spec, ORANGE)
    metadata, capture = model.spec[1], scenes.tiny_capture()
    field, rows = nerf_scene.field(spec, metadata), capture.heldout[:1]
    view, step = evaluation.view_of(capture, int(rows[0])), jnp.asarray(30, jnp.int32)
    codes = field.codes_at(params, view)
    codes["appearance"] = jnp.asarray([3.0, -4.0])
    draw = jax.jit(field.render, static_argnums=4)
    color = draw(params, view.camera, view.time, codes, capture.size, step).color
    capture.images[rows[0]] = evaluation.to_uint8(np.asarray(color))
    state = TrainState(params, (), (), step, jax.random.key(0))
    score = held_out_codes.scorer(spec, metadata, capture.size)
    scored = score(state, capture, rows)
    assert scored.psnr[0] > 48  # of evenly spread samples: 33


def test_a_field_without_codes_has_none_to_fit():
    metadata, _, _ = scenes.tiny_field()
    plain = dataclasses.replace(TINY_FIELD, appearance=None)
    assert held_out_codes.scorer(plain, metadata, (40, 30)) is None
