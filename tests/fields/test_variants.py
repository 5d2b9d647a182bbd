"""Trained fields drawn otherwise."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.scene import scene as nerf_scene
from nerfies_jax.scene import variants
from tests import scenes
from tests.scenes import TINY_FIELD

SIZE = (20, 15)


def test_an_appearance_is_named_by_its_frame_or_its_number():
    capture = scenes.tiny_capture()
    name = capture.ids[2]
    expected = int(capture.appearance_ids[2])
    assert variants.appearance_id(capture, name) == expected
    assert variants.appearance_id(capture, str(expected)) == expected
    for wrong in ("nobody", "-1", "1000"):
        with pytest.raises(ValueError, match=f"'{wrong}' is neither a frame"):
            variants.appearance_id(capture, wrong)


def render(seen, without=(), blended=False):
    metadata, params, _ = scenes.tiny_field()
    draw = variants.without_effects(TINY_FIELD, metadata, without, blended)
    step = jnp.asarray(10, jnp.int32)
    image = jax.jit(draw.render, static_argnums=2)(params, seen, SIZE, step)
    return np.asarray(image.color)


@pytest.mark.full
def test_a_field_without_its_warp_is_the_template():
    metadata, params, view = scenes.tiny_field()
    image = render(view, without=("warp",))
    still = dataclasses.replace(TINY_FIELD, warp=None)
    codes = {"appearance": params["codes"]["appearance"]}
    model = nerf_scene.build(still, metadata)
    expected = jax.jit(model.render, static_argnums=2)(
        {"template": params["template"], "codes": codes}, view, SIZE, jnp.int32(10)
    ).color
    np.testing.assert_allclose(image, expected, atol=1e-6)
    assert np.abs(image - render(view)).max() > 1e-3


@pytest.mark.full
def test_a_blend_starts_at_one_appearance_and_ends_at_the_other():
    view = scenes.tiny_field()[2]
    first, last = (
        view._replace(appearance=jnp.asarray(row, jnp.int32)) for row in (0, 5)
    )
    ends = [render(end) for end in (first, last)]
    assert np.abs(ends[0] - ends[1]).max() > 0.02

    def at(share):
        between = variants.Between(first, last.appearance, jnp.float32(share))
        return render(between, blended=True)

    np.testing.assert_allclose(at(0.0), ends[0], atol=1e-6)
    np.testing.assert_allclose(at(1.0), ends[1], atol=1e-6)
    middle = at(0.5)
    assert all(np.abs(middle - end).max() > 0.005 for end in ends)


def test_what_cannot_be_left_out_or_blended_is_refused():
    metadata, plain = (
        scenes.tiny_field()[0],
        dataclasses.replace(TINY_FIELD, appearance=None),
    )
    with pytest.raises(
        ValueError, match=r"'appearance' cannot be disabled .* that can be: warp"
    ):
        variants.without_effects(TINY_FIELD, metadata, ("appearance",), False)
    with pytest.raises(ValueError, match="has no appearance codes"):
        variants.without_effects(plain, metadata, (), True)
