"""Trained Gaussians drawn otherwise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import scene, splats, static_rows, variants
from gaussians_jax.splats import Gaussians
from nerfies_jax import evaluation
from nerfies_jax.training.model import TrainState
from tests import scenes

SIZE = (20, 15)


@pytest.fixture(scope="module")
def moving():
    """A deformable scene whose network moves something, and a view of it."""
    capture = scenes.tiny_capture()
    metadata = scene.metadata_of(capture)
    model = scene.build(scenes.TINY_DEFORMABLE, metadata)
    params = model.init(capture, jax.random.key(0)).params
    nets = jax.tree.map(lambda leaf: leaf + 0.05, params.nets)
    view = evaluation.view_of(capture, int(capture.heldout[0]))
    return metadata, model, params._replace(nets=nets), view


def test_splats_without_motion_are_the_canonical_ones(moving):
    metadata, model, params, view = moving
    step = jnp.asarray(20, jnp.int32)
    draw = variants.without_effects(
        scenes.TINY_DEFORMABLE, metadata, ("motion",), False
    )
    static = scene.build(scenes.TINY_SPLATS, metadata).render
    found, expected, moved = (
        jax.jit(each, static_argnums=2)(params, view, SIZE, step).colour
        for each in (draw.render, static, model.render)
    )
    np.testing.assert_array_equal(found, expected)
    assert np.abs(found - moved).max() > 0.02


def test_an_effect_that_is_not_there_cannot_be_left_out(moving):
    metadata = moving[0]
    with pytest.raises(ValueError, match=r"--without warp: .* those are: motion"):
        variants.without_effects(scenes.TINY_DEFORMABLE, metadata, ("warp",), False)
    with pytest.raises(ValueError, match=r"--without motion: .* those are: none"):
        variants.without_effects(scenes.TINY_SPLATS, metadata, ("motion",), False)


def test_splats_have_no_appearance_to_blend(moving):
    with pytest.raises(ValueError, match=r"--appearance: splats .* nerf-w"):
        variants.without_effects(scenes.TINY_SPLATS, moving[0], (), True)


def state_of(params):
    return TrainState(params, (), (), jnp.asarray(20, jnp.int32), None)


@pytest.fixture(scope="module")
def swaying():
    """A deformable scene whose Gaussians move at their own speeds."""
    capture = scenes.tiny_capture()
    model = scene.build(scenes.TINY_DEFORMABLE, scene.metadata_of(capture))
    params = model.init(capture, jax.random.key(0)).params
    rng = np.random.default_rng(0)
    nets = jax.tree.map(
        lambda leaf: leaf + 0.1 * jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype),
        params.nets,
    )
    return model, state_of(params._replace(nets=nets))


def deformed_rows(model, state, times=(0.0, 0.3, 1.0)):
    stages = model.stages
    prepared = stages.prepare(state.params)
    deform = jax.jit(stages.deform)
    moments = [jnp.asarray(time, jnp.float32) for time in times]
    return [deform(state.params, prepared, time) for time in moments]


def test_a_motion_from_knots_is_met_at_the_knots_and_near_between(swaying):
    exact = deformed_rows(*swaying)
    active = np.asarray(splats.active_mask(swaying[1].params.rows["splats"]))
    shift = np.abs(exact[0].mean - exact[2].mean).max()
    errors = []
    for knots, interpolation in ((4, "linear"), (4, "cubic"), (40, "cubic")):
        made = variants.from_knots(*swaying, knots, interpolation)
        assert f"{knots} knots, {interpolation}, of" in made.summary
        found = deformed_rows(made.model, made.state)
        for end in (0, 2):
            met = np.abs(found[end].mean - exact[end].mean)[active]
            assert met.max() < 1e-6
        errors.append(np.abs(found[1].mean - exact[1].mean)[active].max() / shift)
    assert 0.2 > errors[0] > errors[1] > 5e-3 > errors[2]


@pytest.mark.full
def test_a_faster_model_draws_what_the_model_draws(swaying):
    model, state = swaying
    view = evaluation.view_of(scenes.tiny_capture(), 0)
    view = view._replace(time=jnp.asarray(0.3))
    made = variants.from_knots(model, state, 40, "cubic")
    whole = made.model._replace(stages=None)  # by its `render`
    exact, staged, found = (
        evaluation.Renderer(model, SIZE)(state, view).colour
        for model, state in ((model, state), made[:2], (whole, made.state))
    )
    static = variants.without_effects(*model.spec, ("motion",), False)
    assert (
        np.abs(evaluation.Renderer(static, SIZE)(state, view).colour - exact).max()
        > 0.1
    )
    np.testing.assert_allclose(staged, exact, atol=1e-3)
    np.testing.assert_allclose(found, staged, atol=1e-5)


@pytest.mark.full
def test_what_stands_still_may_be_left_out(swaying):
    exact = deformed_rows(*swaying)
    made = variants.without_static(*swaying, 0.0)
    active = np.asarray(splats.active_mask(swaying[1].params.rows["splats"]))
    for found, deform in zip(deformed_rows(made.model, made.state), exact, strict=True):
        for name in Gaussians._fields:  # a row that is not drawn may be anywhere
            a, b = (np.asarray(getattr(x, name))[active] for x in (found, deform))
            np.testing.assert_allclose(a, b, atol=2e-6, err_msg=name)
    middle, *_, end = deformed_rows(*swaying, (0.5, 1.0))
    moved = np.asarray(static_rows.max_displacement(middle, end))[active]
    below = float(np.median(moved))
    made = variants.without_static(*swaying, below)
    left = len(made.state.params[1].dynamic.rows["splats"].mean)
    assert 0 < left < len(moved)
    assert f"{left} of {len(active)} rows that move" in made.summary
    for found, deform in zip(deformed_rows(made.model, made.state), exact, strict=True):
        error = np.linalg.norm(found.mean - deform.mean, axis=1)[active]
        assert 0 < error.max() <= below
        assert (error == 0).sum() >= left


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda *a: variants.from_knots(*a, 1), "reads 2 knots at once, got 1"),
        (lambda *a: variants.from_knots(*a, 3, "cubic"), "take more, or linear"),
        (lambda *a: variants.from_knots(*a, 8, "linear", 1e9), "farther than 1e\\+09"),
        (lambda *a: variants.without_static(*a, 1e9), "nothing in this run moves"),
        (lambda *a: variants.without_static(*a, -1.0), "cannot be negative"),
    ],
)
def test_a_faster_motion_that_cannot_be_is_refused(swaying, make, words):
    with pytest.raises(ValueError, match=words):
        make(*swaying)


@pytest.mark.full
def test_what_moves_may_be_left_out(swaying):
    model, state = swaying
    # Slower, so that all stay in the picture
    nets = jax.tree.map(lambda leaf: 0.5 * leaf, state.params.nets)
    state = state_of(state.params._replace(nets=nets))
    middle, *ends = deformed_rows(model, state, (0.5, 0.0, 1.0))
    distance = np.max(
        [static_rows.max_displacement(middle, end) for end in ends], axis=0
    )
    active = np.asarray(splats.active_mask(state.params.rows["splats"]))
    far = float(np.median(distance[active]))
    left, summary = variants.without_moving(model, state, far)
    rows = left.params.rows["splats"]
    shown = np.asarray(splats.active_mask(rows))
    assert 0 < shown.sum() < active.sum() / 2 + 1
    assert distance[shown].max() <= far
    assert f"{active.sum() - shown.sum()} of {active.sum()} Gaussians" in summary
    # What is left is drawn as it was, wherever it still moves a little
    alone = splats.take_rows(state.params, jnp.asarray(np.flatnonzero(shown)))
    view = evaluation.view_of(scenes.tiny_capture(), 0)
    found, expected = (
        evaluation.Renderer(model, SIZE)(one, view).colour
        for one in (left, state._replace(params=alone))
    )
    np.testing.assert_allclose(found, expected, atol=1e-6)
    everything = evaluation.Renderer(model, SIZE)(state, view).colour
    assert np.abs(found - everything).max() > 0.02


def test_a_static_scene_of_nothing_is_refused(swaying):
    with pytest.raises(ValueError, match=r"--hide-moving 0: all .* longer distance"):
        variants.without_moving(*swaying, 0.0)
    field = swaying[0]._replace(stages=None)
    with pytest.raises(ValueError, match="--hide-moving is for runs of Gaussians"):
        variants.without_moving(field, swaying[1], 0.1)


def test_fields_and_still_scenes_have_no_knots(moving, swaying):
    static = variants.without_effects(
        scenes.TINY_DEFORMABLE, moving[0], ("motion",), False
    )
    with pytest.raises(ValueError, match="nothing in this run moves farther than 0 "):
        variants.from_knots(static, swaying[1], 8)
    field = static._replace(stages=None)
    with pytest.raises(ValueError, match="--knots is for runs of Gaussians"):
        variants.from_knots(field, swaying[1], 8)
    with pytest.raises(ValueError, match="--static-threshold is for runs of Gaussians"):
        variants.without_static(field, swaying[1], 0.1)
