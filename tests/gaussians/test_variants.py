"""Trained Gaussians drawn otherwise."""

import dataclasses

import jax
import numpy as np
import pytest

from gaussians_jax.core import splats, static_rows
from gaussians_jax.core.splats import Gaussians
from gaussians_jax.scene import scene, variants
from gaussians_jax.scene.presets import PRESETS
from gaussians_jax.scene.spec import effects_of, motion_of
from nerfies_jax import evaluation
from nerfies_jax.training.model import TrainState
from tests import scenes
from tests.gaussians.motions import moving_scene
from tests.gaussians.shared import jitted, put

SIZE = (20, 15)
max_displacement = jitted(static_rows.max_displacement)


def test_splats_without_motion_are_the_canonical_ones(swaying):
    model, state = swaying
    without = variants.without_effects(*model.spec, ("motion",), False)
    static = scene.build(scenes.TINY_SPLATS, model.spec[1])
    view = evaluation.view_of(scenes.tiny_capture(), 0)
    image, expected = (
        jitted(each.render, static_argnums=2)(state.params, view, SIZE, state.step)
        for each in (without, static)  # with its motion it is another image
    )
    assert np.ptp(image.color) > 0.1
    np.testing.assert_array_equal(image.color, expected.color)


@pytest.mark.parametrize("name", [n for n, s in PRESETS.items() if s.motion])
def test_any_preset_may_be_drawn_without_its_motion(name):
    metadata = scene.metadata_of(scenes.tiny_capture())
    still = effects_of(dataclasses.replace(PRESETS[name], motion=None), metadata)
    assert motion_of(PRESETS[name], metadata).name not in [one.name for one in still]


def state_of(params):
    return TrainState(params, (), (), put(20, "int32"), None)


@pytest.fixture(scope="module")
def swaying():
    """A deformable scene whose Gaussians move at their own speeds."""
    metadata = scene.metadata_of(scenes.tiny_capture())
    return scene.build(scenes.TINY_DEFORMABLE, metadata), state_of(moving_scene())


def active_rows(state):
    return np.asarray(splats.active_mask(state.params.rows["splats"]))


def deformed_rows(model, state, times=(0.0, 0.3, 1.0)):
    prepared = model.stages.prepare(state.params)
    deform = jitted(model.stages.deform)
    return [deform(state.params, prepared, np.float32(time)) for time in times]


def farthest(model, state):
    """How far each row is from where it is in the middle, at either end."""
    middle, *ends = deformed_rows(model, state, (0.5, 0.0, 1.0))
    return np.max([max_displacement(middle, end) for end in ends], axis=0)


def test_a_motion_from_knots_is_met_at_the_knots_and_near_between(swaying):
    exact = deformed_rows(*swaying)
    active = active_rows(swaying[1])
    shift = np.abs(exact[0].mean - exact[2].mean).max()
    errors = []
    for knots, interpolation in ((4, "linear"), (4, "cubic"), (40, "cubic")):
        variant = variants.from_knots(*swaying, knots, interpolation)
        assert f"{knots} knots, {interpolation}, of" in variant.summary
        deforms = deformed_rows(variant.model, variant.state)
        for end in (0, 2):
            met = np.abs(deforms[end].mean - exact[end].mean)[active]
            assert met.max() < 1e-6
        errors.append(np.abs(deforms[1].mean - exact[1].mean)[active].max() / shift)
    assert 0.2 > errors[0] > errors[1] > 5e-3 > errors[2]


@pytest.mark.full
def test_knots_of_a_float64_scene_are_float64(swaying):
    model, state = swaying
    with jax.enable_x64(True):
        state = state._replace(params=put(state.params, "float64"))
        variant = variants.from_knots(model, state, 4)
        moved = variant.model.stages.deform(variant.state.params, (), put(0.0))
    assert moved.mean.dtype == np.float64
    exact, active = deformed_rows(*swaying)[0], active_rows(swaying[1])
    np.testing.assert_allclose(moved.mean[active], exact.mean[active], atol=1e-5)


def test_what_stands_still_may_be_left_out(swaying):
    exact = deformed_rows(*swaying)
    variant = variants.without_static(*swaying, 0.0)
    active = active_rows(swaying[1])
    for left_out, deform in zip(
        deformed_rows(variant.model, variant.state), exact, strict=True
    ):
        for name in Gaussians._fields:  # a row that is not drawn may be anywhere
            a, b = (np.asarray(getattr(x, name))[active] for x in (left_out, deform))
            np.testing.assert_allclose(a, b, atol=2e-6, err_msg=name)
    moved = farthest(*swaying)[active]
    below = float(np.median(moved))
    variant = variants.without_static(*swaying, below)
    left = len(variant.state.params[1].dynamic.rows["splats"].mean)
    assert 0 < left < len(moved)
    assert f"{left} of {len(active)} moving Gaussians" in variant.summary
    for left_out, deform in zip(
        deformed_rows(variant.model, variant.state), exact, strict=True
    ):
        error = np.linalg.norm(left_out.mean - deform.mean, axis=1)[active]
        assert 0 < error.max() <= below
        assert (error == 0).sum() >= left


def drawn_still(model, *args):
    static = variants.without_effects(*model.spec, ("motion",), False)
    return variants.from_knots(static, *args)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda *a: variants.from_knots(*a, 1), "reads 2 knots at once, got 1"),
        (lambda *a: variants.from_knots(*a, 3, "cubic"), "use more knots or linear"),
        (lambda *a: variants.from_knots(*a, 8, "linear", 1e9), "farther than 1e\\+09"),
        (lambda *a: drawn_still(*a, 8), "nothing in this run moves farther than 0 "),
        (lambda *a: variants.without_static(*a, 1e9), "nothing in this run moves"),
        (lambda *a: variants.without_static(*a, -1.0), "cannot be negative"),
        (lambda *a: variants.without_moving(*a, 0.0),
         r"move farther than 0 scene .* longer distance"),
        (lambda m, s: variants.from_knots(m._replace(stages=None), s, 8),
         "knots needs a run of Gaussians"),
        (lambda m, s: variants.without_static(m._replace(stages=None), s, 0.1),
         "static Gaussians needs a run of Gaussians"),
        (lambda m, s: variants.without_moving(m._replace(stages=None), s, 0.1),
         "moving Gaussians needs a run of Gaussians"),
        (lambda m, _: variants.without_effects(*m.spec, ("warp",), False),
         r"'warp' cannot be disabled .* that can be: motion"),
        (lambda m, _: variants.without_effects(
            scenes.TINY_SPLATS, m.spec[1], ("motion",), False),
         r"'motion' cannot be disabled .* that can be: none"),
        (lambda m, _: variants.without_effects(*m.spec, (), True),
         r"splats have no appearance .* nerf-w"),
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_otherwise_is_refused(swaying, make, words):
    with pytest.raises(ValueError, match=words):
        make(*swaying)


@pytest.mark.full
def test_what_moves_may_be_left_out(swaying):
    model, state = swaying
    # Slower, so that all stay in the image
    nets = jax.tree.map(lambda leaf: put(np.asarray(leaf) / 2), state.params.nets)
    state = state_of(state.params._replace(nets=nets))
    distance, active = farthest(model, state), active_rows(state)
    far = float(np.median(distance[active]))
    left, summary = variants.without_moving(model, state, far)
    shown = active_rows(left)
    assert 0 < shown.sum() < active.sum() / 2 + 1
    assert distance[shown].max() <= far
    assert f"{active.sum() - shown.sum()} of {active.sum()} Gaussians" in summary
    # What is left is drawn as it was, wherever it still moves a little
    alone = jax.jit(splats.take_rows)(state.params, np.flatnonzero(shown))
    view = evaluation.view_of(scenes.tiny_capture(), 0)
    image, expected = (
        evaluation.Renderer(model, SIZE)(one, view).color
        for one in (left, state._replace(params=alone))
    )
    np.testing.assert_allclose(image, expected, atol=1e-6)
    everything = evaluation.Renderer(model, SIZE)(state, view).color
    assert np.abs(image - everything).max() > 0.02
