"""Trained fields drawn otherwise."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation, variants
from nerfies_jax import scene as nerf_scene
from nerfies_jax.effects.appearance import AppearanceSpec
from nerfies_jax.effects.warp import WarpSpec
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.radiance.template import TemplateSpec
from nerfies_jax.spec import RadianceScene, SamplingSpec
from tests import scenes

SIZE = (20, 15)


def test_an_appearance_is_named_by_its_frame_or_its_number():
    capture = scenes.tiny_capture()
    name = capture.ids[2]
    expected = int(capture.appearance_ids[2])
    assert variants.appearance_id(capture, name) == expected
    assert variants.appearance_id(capture, str(expected)) == expected
    for wrong in ("nobody", "-1", "1000"):
        with pytest.raises(ValueError, match=f"--appearance {wrong}: neither a frame"):
            variants.appearance_id(capture, wrong)


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


def drawn(field, seen, without=(), blended=False):
    metadata, params, _ = field
    draw = variants.without_effects(TINY_FIELD, metadata, without, blended)
    step = jnp.asarray(10, jnp.int32)
    return jax.jit(draw.render, static_argnums=2)(params, seen, SIZE, step).colour


@pytest.mark.full
def test_a_field_without_its_warp_is_the_template(field):
    metadata, params, view = field
    found = drawn(field, view, without=("warp",))
    still = dataclasses.replace(TINY_FIELD, warp=None)
    step = jnp.asarray(10, jnp.int32)
    codes = {"appearance": params["codes"]["appearance"]}
    model = nerf_scene.build(still, metadata)
    expected = jax.jit(model.render, static_argnums=2)(
        {"template": params["template"], "codes": codes}, view, SIZE, step
    ).colour
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(found - drawn(field, view)).max() > 1e-3


@pytest.mark.full
def test_a_blend_starts_at_one_appearance_and_ends_at_the_other(field):
    view = field[2]
    first, last = (
        view._replace(appearance=jnp.asarray(row, jnp.int32)) for row in (0, 5)
    )
    ends = [drawn(field, end) for end in (first, last)]
    assert np.abs(ends[0] - ends[1]).max() > 0.02

    def at(share):
        share = jnp.asarray(share, jnp.float32)
        between = variants.Between(first, last.appearance, share)
        return drawn(field, between, blended=True)

    np.testing.assert_allclose(at(0.0), ends[0], atol=1e-6)
    np.testing.assert_allclose(at(1.0), ends[1], atol=1e-6)
    assert all(np.abs(at(0.5) - end).max() > 0.005 for end in ends)


def test_what_feeds_the_network_cannot_be_left_out(field):
    with pytest.raises(ValueError, match=r"--without appearance: .* those are: warp"):
        variants.without_effects(TINY_FIELD, field[0], ("appearance",), False)


def test_a_field_without_codes_has_no_appearance_to_blend(field):
    plain = dataclasses.replace(TINY_FIELD, appearance=None)
    with pytest.raises(ValueError, match=r"--appearance: .* no appearance codes"):
        variants.without_effects(plain, field[0], (), True)
