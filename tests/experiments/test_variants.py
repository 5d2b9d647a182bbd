"""Trained scenes drawn otherwise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import evaluate, variants
from gaussians_jax import scene
from tests import scenes

SIZE = (20, 15)


@pytest.fixture(scope="module")
def moving():
    """A deformable scene whose network moves something, and a view of it."""
    capture = scenes.tiny_capture()
    facts = scene.facts_of(capture)
    model = scene.build(scenes.TINY_DEFORMABLE, facts)
    params = model.init(capture, jax.random.key(0)).params
    nets = jax.tree.map(lambda leaf: leaf + 0.05, params.nets)
    view = evaluate.view_of(capture, int(capture.heldout[0]))
    return facts, model, params._replace(nets=nets), view


def test_splats_without_motion_are_the_canonical_ones(moving):
    facts, model, params, view = moving
    step = jnp.asarray(20, jnp.int32)
    draw = variants.of_splats(scenes.TINY_DEFORMABLE, facts, ("motion",), False)
    still = scene.build(scenes.TINY_SPLATS, facts).render
    found, expected, moved = (
        jax.jit(each, static_argnums=2)(params, view, SIZE, step).colour
        for each in (draw, still, model.render)
    )
    np.testing.assert_array_equal(found, expected)
    assert np.abs(found - moved).max() > 0.02


def test_an_effect_that_is_not_there_cannot_be_left_out(moving):
    facts = moving[0]
    with pytest.raises(ValueError, match=r"--without warp: .* it has motion"):
        variants.of_splats(scenes.TINY_DEFORMABLE, facts, ("warp",), False)
    with pytest.raises(ValueError, match=r"--without motion: .* it has none"):
        variants.of_splats(scenes.TINY_SPLATS, facts, ("motion",), False)


def test_splats_have_no_appearance_to_blend(moving):
    with pytest.raises(ValueError, match=r"--appearance: splats .* nerf-w"):
        variants.of_splats(scenes.TINY_SPLATS, moving[0], (), True)


def test_an_appearance_is_named_by_its_frame_or_its_number():
    capture = scenes.tiny_capture()
    name = capture.ids[2]
    expected = int(capture.appearance_ids[2])
    assert variants.appearance_id(capture, name) == expected
    assert variants.appearance_id(capture, str(expected)) == expected
    for wrong in ("nobody", "-1", "1000"):
        with pytest.raises(ValueError, match=f"--appearance {wrong}: neither a frame"):
            variants.appearance_id(capture, wrong)
