"""A spec becomes a model: its start, its step, its events."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.init import points as initialization
from gaussians_jax.init.points import InitSpec
from gaussians_jax.optim import learning_rates
from gaussians_jax.optim.densification import DefaultStrategySpec
from gaussians_jax.optim.learning_rates import LearningRateSpec
from gaussians_jax.scene import first_state, presets, scene, view_order
from gaussians_jax.scene.spec import SceneMetadata, raster_of
from nerfies_jax import evaluation
from nerfies_jax.runtime import compiler
from nerfies_jax.training.updates import apply_updates
from tests import scenes
from tests.gaussians.shared import finite, full, jitted, put, with_rows

KEY = 3


@functools.cache
def started(spec):
    capture = scenes.tiny_capture()
    model = scene.build(spec, scene.metadata_of(capture))
    return (
        model,
        model.init(capture, jax.random.key(KEY)),
        evaluation.frames_of(capture),
    )


@functools.cache
def compiled_step(spec):
    return jax.jit(started(spec)[0].step)


@functools.cache
def stepped(spec, count):
    _, state, frames = started(spec)
    step = compiled_step(spec)
    trace = []
    for _ in range(count):
        state, metrics = step(state, frames)
        trace.append({name: float(value) for name, value in metrics.items()})
    return state, trace


def test_a_model_is_compiled_with_its_short_loops_whole():
    assert started(scenes.TINY_SPLATS)[0].compiler_options == compiler.UNDIVIDED


def test_training_lowers_the_loss():
    _, trace = stepped(scenes.TINY_SPLATS, 25)
    first = np.mean([row["loss"] for row in trace[:6]])  # an epoch each
    last = np.mean([row["loss"] for row in trace[18:24]])
    assert last < 0.95 * first, (first, last)


@pytest.mark.full
def test_a_step_of_two_views_goes_down_the_mean_of_both():
    _, state, frames = started(scenes.TINY_SPLATS)
    pair, trace = stepped(dataclasses.replace(scenes.TINY_SPLATS, batch_size=2), 1)
    later = state._replace(step=state.step + 1)  # of the same parameters
    one, other = (compiled_step(scenes.TINY_SPLATS)(s, frames) for s in (state, later))
    losses = [float(metrics["loss"]) for _, metrics in (one, other)]
    np.testing.assert_allclose(trace[0]["loss"], np.mean(losses), rtol=1e-5)
    seen = [each[0].aux_state.stats.views for each in (one, other)]
    np.testing.assert_array_equal(pair.aux_state.stats.views, sum(seen))
    assert int(pair.step) == 1


def test_every_epoch_shows_every_frame_once_in_its_own_order():
    rows = jitted(jax.vmap(view_order.shuffled_row, (None, 0, None)), static_argnums=2)
    epochs = rows(jax.random.key(0), np.arange(21, dtype=np.int32), 7).reshape(3, 7)
    assert (np.sort(epochs, axis=1) == np.arange(7)).all()
    assert len({tuple(epoch) for epoch in epochs}) == 3


def test_descent_scales_each_kind_of_row_by_its_rate():
    spec = LearningRateSpec(mean=1e-2, mean_end=1e-4, log_scale=0.1, quaternion=0.2)
    zeros = Params({"splats": Splats(*np.zeros((6, 4), np.float32))}, {})
    ones = jax.tree.map(np.ones_like, zeros)

    @jitted
    def after(step):
        rate = learning_rates.at_step(spec, 2.0, 100, step)
        return apply_updates(zeros, ones, Params({"splats": rate}, {}))

    step = after(np.int32(50)).rows["splats"]
    # Halfway in the logarithm between 1e-2 and 1e-4, times the extent of 2.
    np.testing.assert_allclose(step.mean, -2e-3, rtol=2e-3)
    np.testing.assert_allclose(step.log_scale, -0.1, rtol=1e-5)
    np.testing.assert_allclose(step.quaternion, -0.2, rtol=1e-5)


def test_events_grow_the_scene_and_keep_its_image_learnable():
    model, _, frames = started(scenes.TINY_SPLATS)
    state, _ = stepped(scenes.TINY_SPLATS, 10)
    grow = next(event for event in model.events if event.name == "densify")
    assert grow.steps == (10, 20)
    spec = dataclasses.replace(
        scenes.TINY_SPLATS,
        strategy=dataclasses.replace(scenes.TINY_SPLATS.strategy, grow_grad2d=1e-9),
    )
    eager = scene.build(spec, scene.metadata_of(scenes.tiny_capture()))
    after = eager.events[0].apply(state, frames)
    assert model.counts(after)["gaussians"] > model.counts(state)["gaussians"]
    assert int(after.step) == int(state.step)
    shapes, _ = jax.eval_shape(eager.step, after, frames)
    rows = shapes.params.rows["splats"].mean.shape[0]
    assert rows == len(after.aux_state.stats.active)
    assert finite(after.params)


def test_a_frame_has_the_harmonics_of_its_step():
    model, state, _ = started(scenes.TINY_SPLATS)
    capture = scenes.tiny_capture()
    view = evaluation.view_of(capture, int(capture.heldout[0]))
    plain = state.params
    rest = put(np.asarray(plain.rows["splats"].sh_rest) + np.float32(0.3))
    shaded = with_rows(plain, sh_rest=rest)
    render = jitted(model.render, static_argnums=2)

    def color(params, step):
        rendering = render(params, view, (20, 15), np.int32(step))
        assert rendering.depth.shape == rendering.alpha.shape == (15, 20)
        assert finite(rendering)
        return rendering.color

    every = scenes.TINY_SPLATS.sh_every  # below it no band but the first has trained
    np.testing.assert_array_equal(color(shaded, every - 1), color(plain, every))
    assert np.abs(color(shaded, every) - color(plain, every)).max() > 0.05


def test_few_points_start_from_random_ones_in_the_views():
    capture = scenes.tiny_capture()
    spec = InitSpec(random=50, min_points=10**6)
    position, color = initialization.initial_points(spec, capture, 0)
    assert position.shape == color.shape == (50, 3)
    turn = capture.cameras.camera_from_world[capture.train]
    offset = position[None] - capture.cameras.position[capture.train][:, None]
    depth = np.einsum("fk,fnk->fn", turn[:, 2], offset)
    seen = (depth > 0.99 * capture.near) & (depth < 1.01 * capture.far)
    assert seen.any(axis=0).all()


def test_more_points_than_asked_for_are_thinned_without_repeats():
    position, _ = initialization.initial_points(
        InitSpec(points=120), scenes.tiny_capture(), 0
    )
    assert len(np.unique(position, axis=0)) == len(position) == 120


def test_facts_take_a_depth_for_the_extent_of_a_camera_that_stands_still():
    capture = scenes.tiny_capture()
    still = np.broadcast_to(capture.cameras.position[:1], (len(capture.ids), 3)).copy()
    capture = dataclasses.replace(
        capture, cameras=capture.cameras._replace(position=still)
    )
    assert capture.near < scene.metadata_of(capture).extent < capture.far


@pytest.mark.hard_cases
@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_what_was_observed_is_rendered_however_small_its_units_are(unit):
    """Where far points span the box, 0.01 of it is meters before the camera."""
    capture = scenes.tiny_capture()
    small = dataclasses.replace(
        capture,
        near=capture.near * unit,
        far=capture.far * unit,
        points=capture.points._replace(position=capture.points.position * unit),
        cameras=capture.cameras._replace(position=capture.cameras.position * unit),
    )
    plain = scenes.TINY_SPLATS.raster
    near = raster_of(scenes.TINY_SPLATS, scene.metadata_of(small)).near
    assert near <= min(plain.near, 0.3 * small.near)
    assert (near == plain.near) == (unit == 1.0)
    model = scene.build(scenes.TINY_SPLATS, scene.metadata_of(small))
    state = model.init(small, jax.random.key(KEY))
    view = evaluation.view_of(small, 0)
    rendering = jax.jit(model.render, static_argnums=2)(
        state.params, view, small.size, state.step
    )
    assert np.asarray(rendering.alpha).mean() > 0.1


# Fields of the parts that count steps.
COUNTED = {
    "strategy": ("refine_start_iter", "refine_stop_iter"),
    "motion": ("warm_up",),
    "alternation": ("start", "stop"),
    "annealing": ("after",),
    "acceleration": ("start",),
    "neighbors": ("start",),
    "motion_growth": ("start",),
    "spectral": ("after",),
}


@pytest.mark.parametrize(
    "name", ["moba", *full(*sorted(presets.PRESETS.keys() - {"moba"}))]
)
def test_presets_build_and_stretch_with_their_steps(name):
    spec = presets.PRESETS[name]
    box = ((-1.0,) * 3, (1.0,) * 3)
    metadata = SceneMetadata(1.0, (0.0, 0.0, 0.0), frames=10, box=box)
    half = presets.with_steps(spec, spec.steps // 2)
    assert half.steps == spec.steps // 2
    for part, fields in COUNTED.items():
        whole, short = getattr(spec, part), getattr(half, part)
        for name in fields if whole is not None else ():
            assert getattr(short, name) == 10 * round(getattr(whole, name) / 20)
    if isinstance(spec.strategy, DefaultStrategySpec):
        whole, short = (each.strategy.reset_every for each in (spec, half))
        assert short == 10 * round(whole / 20)
    assert half.sh_every == 10 * round(spec.sh_every / 20)
    assert scene.build(half, metadata).spec == (half, metadata)
    assert presets.with_steps(spec, spec.steps) == spec
    for few in (1, 2, 3):
        assert presets.with_steps(spec, few).steps == few


def test_estimate_memory_counts_rows_and_capacity():
    capture = scenes.tiny_capture()
    small = first_state.estimate_memory_bytes(scenes.TINY_SPLATS, capture)
    slab = dataclasses.replace(scenes.TINY_SPLATS.raster, capacity=10**12)
    large = first_state.estimate_memory_bytes(
        dataclasses.replace(scenes.TINY_SPLATS, raster=slab), capture
    )
    assert small < 10**7
    assert large > 10**12
