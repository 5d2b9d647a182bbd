"""Trained scenes drawn otherwise."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import variants
from gaussians_jax import scene, splats, still_rows
from gaussians_jax.splats import Gaussians
from nerfies_jax import evaluation, held_out_codes
from nerfies_jax import scene as nerf_scene
from nerfies_jax.effects.appearance import AppearanceSpec
from nerfies_jax.effects.warp import WarpSpec
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.radiance.template import TemplateSpec
from nerfies_jax.spec import RadianceScene, SamplingSpec
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
    draw = variants.of_splats(scenes.TINY_DEFORMABLE, metadata, ("motion",), False)
    still = scene.build(scenes.TINY_SPLATS, metadata).render
    found, expected, moved = (
        jax.jit(each, static_argnums=2)(params, view, SIZE, step).colour
        for each in (draw.render, still, model.render)
    )
    np.testing.assert_array_equal(found, expected)
    assert np.abs(found - moved).max() > 0.02


def test_an_effect_that_is_not_there_cannot_be_left_out(moving):
    metadata = moving[0]
    with pytest.raises(ValueError, match=r"--without warp: .* those are: motion"):
        variants.of_splats(scenes.TINY_DEFORMABLE, metadata, ("warp",), False)
    with pytest.raises(ValueError, match=r"--without motion: .* those are: none"):
        variants.of_splats(scenes.TINY_SPLATS, metadata, ("motion",), False)


def test_splats_have_no_appearance_to_blend(moving):
    with pytest.raises(ValueError, match=r"--appearance: splats .* nerf-w"):
        variants.of_splats(scenes.TINY_SPLATS, moving[0], (), True)


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


def poses(model, state, times=(0.0, 0.3, 1.0)):
    stages = model.stages
    prepared = stages.prepare(state.params)
    pose = jax.jit(stages.pose)
    moments = [jnp.asarray(time, jnp.float32) for time in times]
    return [pose(state.params, prepared, time) for time in moments]


def test_a_motion_from_knots_is_met_at_the_knots_and_near_between(swaying):
    exact = poses(*swaying)
    living = np.asarray(splats.alive(swaying[1].params.rows["splats"]))
    shift = np.abs(exact[0].mean - exact[2].mean).max()
    errors = []
    for knots, interpolation in ((4, "linear"), (4, "cubic"), (40, "cubic")):
        made = variants.from_knots(*swaying, knots, interpolation)
        assert f"{knots} knots, {interpolation}, of" in made.summary
        found = poses(made.model, made.state)
        for end in (0, 2):
            met = np.abs(found[end].mean - exact[end].mean)[living]
            assert met.max() < 1e-6
        errors.append(np.abs(found[1].mean - exact[1].mean)[living].max() / shift)
    assert 0.2 > errors[0] > errors[1] > 5e-3 > errors[2]


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
    still = variants.of_splats(*model.spec, ("motion",), False)
    assert (
        np.abs(evaluation.Renderer(still, SIZE)(state, view).colour - exact).max() > 0.1
    )
    np.testing.assert_allclose(staged, exact, atol=1e-3)
    np.testing.assert_allclose(found, staged, atol=1e-5)


def test_what_stands_still_may_be_left_out(swaying):
    exact = poses(*swaying)
    made = variants.without_still(*swaying, 0.0)
    living = np.asarray(splats.alive(swaying[1].params.rows["splats"]))
    for found, pose in zip(poses(made.model, made.state), exact, strict=True):
        for name in Gaussians._fields:  # a row that is not drawn may be anywhere
            a, b = (np.asarray(getattr(x, name))[living] for x in (found, pose))
            np.testing.assert_allclose(a, b, atol=2e-6, err_msg=name)
    middle, *_, end = poses(*swaying, (0.5, 1.0))
    moved = np.asarray(still_rows.reach(middle, end))[living]
    below = float(np.median(moved))
    made = variants.without_still(*swaying, below)
    left = len(made.state.params[1].moving.rows["splats"].mean)
    assert 0 < left < len(moved)
    assert f"{left} of {len(living)} rows that move" in made.summary
    for found, pose in zip(poses(made.model, made.state), exact, strict=True):
        error = np.linalg.norm(found.mean - pose.mean, axis=1)[living]
        assert 0 < error.max() <= below
        assert (error == 0).sum() >= left


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda *a: variants.from_knots(*a, 1), "reads 2 knots at once, got 1"),
        (lambda *a: variants.from_knots(*a, 3, "cubic"), "take more, or linear"),
        (lambda *a: variants.from_knots(*a, 8, "linear", 1e9), "farther than 1e\\+09"),
        (lambda *a: variants.without_still(*a, 1e9), "nothing in this run moves"),
        (lambda *a: variants.without_still(*a, -1.0), "cannot be negative"),
    ],
)
def test_a_faster_motion_that_cannot_be_is_refused(swaying, make, words):
    with pytest.raises(ValueError, match=words):
        make(*swaying)


def test_what_moves_may_be_left_out(swaying):
    model, state = swaying
    # Slower, so that all stay in the picture
    nets = jax.tree.map(lambda leaf: 0.5 * leaf, state.params.nets)
    state = state_of(state.params._replace(nets=nets))
    middle, *ends = poses(model, state, (0.5, 0.0, 1.0))
    reach = np.max([still_rows.reach(middle, end) for end in ends], axis=0)
    living = np.asarray(splats.alive(state.params.rows["splats"]))
    far = float(np.median(reach[living]))
    left, summary = variants.without_moving(model, state, far)
    rows = left.params.rows["splats"]
    shown = np.asarray(splats.alive(rows))
    assert 0 < shown.sum() < living.sum() / 2 + 1
    assert reach[shown].max() <= far
    assert f"{living.sum() - shown.sum()} of {living.sum()} Gaussians" in summary
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
    still = variants.of_splats(scenes.TINY_DEFORMABLE, moving[0], ("motion",), False)
    with pytest.raises(ValueError, match="nothing in this run moves farther than 0 "):
        variants.from_knots(still, swaying[1], 8)
    field = still._replace(stages=None)
    with pytest.raises(ValueError, match="--knots is for runs of Gaussians"):
        variants.from_knots(field, swaying[1], 8)
    with pytest.raises(ValueError, match="--still-below is for runs of Gaussians"):
        variants.without_still(field, swaying[1], 0.1)


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
    draw = variants.of_fields(TINY_FIELD, metadata, without, blended)
    step = jnp.asarray(10, jnp.int32)
    return jax.jit(draw.render, static_argnums=2)(params, seen, SIZE, step).colour


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
        variants.of_fields(TINY_FIELD, field[0], ("appearance",), False)


def test_a_field_without_codes_has_no_appearance_to_blend(field):
    plain = dataclasses.replace(TINY_FIELD, appearance=None)
    with pytest.raises(ValueError, match=r"--appearance: .* no appearance codes"):
        variants.of_fields(plain, field[0], (), True)


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
    assert held_out_codes.score(plain, field[0], None, None, None) is None
