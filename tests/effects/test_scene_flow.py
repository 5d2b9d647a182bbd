"""The time-varying medium: a loop over rays in NumPy, a wall that moves, the edges."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation, scene
from nerfies_jax.effects import scene_flow
from nerfies_jax.effects.effect import Sample
from nerfies_jax.effects.scene_flow import FlowWeights, SceneFlowSpec
from nerfies_jax.scene import RadianceScene
from nerfies_jax.spec import SamplingSpec
from nerfies_jax.training.effects import FrameCondition
from tests import gradients, scenes
from tests.scene_flow_rays import (
    BOX_CENTRE,
    BOX_SCALE,
    FEATURES,
    MOMENTS,
    RAYS,
    ROWS,
    SIZE,
    TINY,
    context_of,
    frames_and_batch,
    oracle,
    scenario,
)


@functools.partial(jax.jit, static_argnums=0)
def terms_of(spec, params, frames, batch, arrays, step):
    context = context_of(spec, params, frames, batch, *arrays, step)
    gap = scene_flow.interval(MOMENTS)
    return scene_flow.penalty(spec, gap, params, context)


@pytest.mark.parametrize("step", [0, 250])
def test_terms_are_sums_over_rays_and_samples_one_by_one(dtype, step):
    given = scenario(dtype)
    found = terms_of(TINY, *given, step)
    expected = oracle(*given, step)
    assert set(found) == set(expected)
    for name, value in expected.items():
        # float32 rounds a few ulps of the coordinates, and divides by a deviation
        error = abs(float(found[name].value) - value)
        assert error < {"float32": 3e-5, "float64": 1e-11}[dtype] * max(1, value), name


def test_weights_are_the_spec_s_and_the_capture_s_own_terms_fade(dtype):
    given = scenario(dtype)
    weights = dataclasses.asdict(TINY.weights)
    for step, fade in ((0, 1.0), (99, 1.0), (100, 0.1), (250, 0.01), (10**6, 0.0)):
        for name, term in terms_of(TINY, *given, step).items():
            expected = weights[name] * (fade if name in ("depth", "flow") else 1)
            np.testing.assert_allclose(term.weight, expected, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize("step", [pytest.param(0, marks=pytest.mark.full), 250])
def test_the_whole_penalty_has_the_slope_of_its_differences(float64, step):
    params, frames, batch, arrays = scenario("float64")
    # What is held fixed on purpose has no slope to compare: left out, or its weight is
    # of another medium here.
    weights = dataclasses.replace(TINY.weights, magnitude=0.0, warped=0.0)
    spec = dataclasses.replace(TINY, weights=weights)

    def loss(params, arrays):
        terms = terms_of(spec, params, frames, batch, [*arrays, given_weight], step)
        return sum(term.value for term in terms.values())

    given_weight = arrays[2]
    assert gradients.directional_error(loss, params, arrays[:2], step=1e-6) < 1e-6


def test_terms_with_a_weight_of_zero_are_not_there(float64):
    params, frames, batch, arrays = scenario("float64")
    spec = dataclasses.replace(TINY, weights=FlowWeights(**dict.fromkeys(NAMES, 0.0)))
    assert terms_of(spec, params, frames, batch, arrays, 0) == {}
    assert scene_flow.effect(spec, 4, FEATURES).required_data == frozenset()
    only_flow = dataclasses.replace(spec, weights=FlowWeights(depth=0.0))
    assert scene_flow.effect(only_flow, 4, FEATURES).required_data == {"flow"}
    assert scene_flow.effect(TINY, 4, FEATURES).required_data == {"flow", "depths"}


NAMES = tuple(field.name for field in dataclasses.fields(FlowWeights))


@pytest.mark.full
def test_without_depth_and_flow_in_the_capture_their_terms_are_not_there(float64):
    params, frames, batch, arrays = scenario("float64")
    bare = frames._replace(depths=None, flow=None)
    found = terms_of(TINY, params, bare, batch, arrays, 0)
    assert set(found) == set(NAMES) - {"depth", "flow"}


# --- edges of time


@functools.partial(jax.jit, static_argnums=4)
def slopes_of(params, frames, batch, arrays, gap):
    """Slopes of all terms in parameters and in what the medium says, and the terms."""
    medium = context_of(TINY, params, frames, batch, *arrays, 0).levels[0].media

    def total(params, shift):
        context = context_of(TINY, params, frames, batch, *arrays, 0)
        level = context.levels[0]
        own = level.media["scene_flow"]
        own = own._replace(extras=jax.tree.map(jnp.add, own.extras, shift))
        level = level._replace(media={"scene_flow": own})
        terms = scene_flow.penalty(TINY, gap, params, context._replace(levels=(level,)))
        return sum(term.value for term in terms.values()), terms

    shift = jax.tree.map(jnp.zeros_like, medium["scene_flow"].extras)
    return jax.grad(total, (0, 1), has_aux=True)(params, shift)


@pytest.mark.hard_cases
def test_the_first_and_the_last_moment_have_one_neighbour(float64):
    (_, grad), _ = slopes_of(*scenario("float64"), 1 / 3)
    strength = {name: np.abs(np.asarray(x)).sum((1, -1)) for name, x in grad.items()}
    rows = np.array(ROWS)
    for name, missing in (("flow_forward", MOMENTS - 1), ("flow_backward", 0)):
        assert (strength[name][rows == missing] == 0).all()
        assert (strength[name][rows != missing] > 0).all()
    hidden = np.abs(np.asarray(grad["disocclusion"])).sum(1)  # rays, sides
    assert (hidden[rows == MOMENTS - 1, 0] == 0).all()
    assert (hidden[rows == 0, 1] == 0).all()


@pytest.mark.full
@pytest.mark.hard_cases
def test_a_single_moment_has_no_neighbours_and_no_flow_to_learn(dtype):
    params, frames, batch, arrays = scenario(dtype)
    still = frames._replace(times=np.zeros(MOMENTS, dtype))
    found = slopes_of(params, still, batch, arrays, scene_flow.interval(1))
    (grad, _), terms = jax.tree.map(np.asarray, found)
    for name in ("warped", "cycle", "disocclusion", "magnitude", "kinetic", "flow"):
        assert terms[name].value == 0, name
    assert terms["dynamic"].value > 0
    assert (grad.flow.weight == 0).all()
    assert (grad.flow.bias == 0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grad))


def test_interval_of_moments():
    assert scene_flow.interval(11) == 0.1
    assert scene_flow.interval(1) > 1
    with pytest.raises(ValueError, match="moments=0"):
        scene_flow.interval(0)


# --- a wall that moves sideways


VELOCITY = np.array([0.12, -0.06, 0.0])  # field units from one moment to the next


def wall(velocity=VELOCITY, flow=VELOCITY):
    """A slanted, textured, opaque wall that slides in its own plane; analytic."""

    def at(spec, params, point, direction, time):
        # The wall is z = 0.3 x + 0.6 y, in which the velocity lies.
        depth = point[2] - 0.3 * point[0] - 0.6 * point[1]
        at_start = point - 3 * time * jnp.asarray(velocity, point.dtype)
        colour = 0.5 + 0.4 * jnp.sin(
            jnp.asarray([7.0, 5.0, 3.0], point.dtype) * (at_start[0] - 2 * at_start[1])
        )
        both = jnp.asarray(np.stack([flow, -np.asarray(flow)]), point.dtype)
        # Hidden is nothing: the logit of a probability of 2e-9.
        return scene_flow.Dynamic(
            jnp.where(depth > 0, 1e4, 0.0).astype(point.dtype),
            colour,
            both,
            jnp.full(2, -20.0, point.dtype),
        )

    return at


def filmed_wall(dtype):
    """Rays onto the wall with the pictures, depths and flow that a camera sees."""
    rng = np.random.default_rng(2)
    frames, batch = frames_and_batch(rng, "float64")
    distance = np.linspace(1.2, 3.0, 20)[None] * np.ones((RAYS, 1))
    width, height = SIZE
    forward = np.zeros((MOMENTS, height, width, 2))
    backward = np.zeros_like(forward)
    depths = np.zeros((MOMENTS, height, width))
    colour = np.zeros((RAYS, 3))
    batch = jax.tree.map(np.asarray, batch)
    for r, row in enumerate(ROWS):
        origin = (batch.origin[r] - BOX_CENTRE) * BOX_SCALE
        points = origin + distance[r][:, None] * batch.direction[r]
        inside = points[:, 2] - 0.3 * points[:, 0] - 0.6 * points[:, 1] > 0
        hit = points[np.argmax(inside)]
        assert inside.any()
        assert not inside[0]
        start = hit - 3 * float(frames.times[row]) * VELOCITY
        colour[r] = 0.5 + 0.4 * np.sin(np.array([7, 5, 3]) * (start[0] - 2 * start[1]))
        column, line = int(batch.pixel[r, 0]), int(batch.pixel[r, 1])
        # Twice too deep and off by one: the term is blind to both.
        along = distance[r][np.argmax(inside)] * batch.cosine[r] / BOX_SCALE
        depths[row, line, column] = 2 * along + 1
        for pictures, sign in ((forward, 1), (backward, -1)):
            other = min(max(row + sign, 0), MOMENTS - 1)
            elapsed = 3 * (float(frames.times[other]) - float(frames.times[row]))
            place = (hit + elapsed * VELOCITY) / BOX_SCALE + np.array(BOX_CENTRE)
            turn = np.asarray(frames.cameras.camera_from_world[other])
            x, y, z = turn @ (place - np.asarray(frames.cameras.position[other]))
            pixel = 9.0 * np.array([x, y]) / z + np.array(SIZE) / 2
            pictures[row, line, column] = pixel - batch.pixel[r]
    flow = frames.flow._replace(
        forward=forward,
        backward=backward,
        forward_seen=np.ones_like(frames.flow.forward_seen),
        backward_seen=np.ones_like(frames.flow.backward_seen),
    )
    batch = batch._replace(colour=colour, valid=np.ones(RAYS, bool))
    frames = frames._replace(flow=flow, depths=depths)

    def cast(x):
        x = np.asarray(x)
        return jnp.asarray(x.astype(dtype) if x.dtype.kind == "f" else x)

    arrays = [distance, np.zeros((RAYS, 20, FEATURES)), np.full((RAYS, 20), 0.05)]
    return jax.tree.map(cast, (frames, batch, arrays))


def wall_terms(monkeypatch, dtype, **motion):
    frames, batch, arrays = filmed_wall(dtype)
    params = scene_flow.init(TINY, jax.random.key(0), FEATURES, jnp.dtype(dtype))
    monkeypatch.setattr(scene_flow, "dynamic", wall(**motion))

    @jax.jit  # of this call: the wall is looked up while it is traced
    def values():
        context = context_of(TINY, params, frames, batch, *arrays, 0)
        found = scene_flow.penalty(TINY, 1 / 3, params, context)
        return {name: term.value for name, term in found.items()}

    return jax.tree.map(float, values())


@pytest.mark.full
def test_the_true_flow_of_a_moving_wall_costs_nothing(monkeypatch, dtype):
    found = wall_terms(monkeypatch, dtype)
    # float32: pixels to a few ulps of the picture's size
    least = {"float32": 2e-5, "float64": 1e-12}[dtype]
    for name in ("dynamic", "warped", "cycle", "kinetic", "smoothness", "flow"):
        assert found[name] < least, name
    assert found["depth"] < {"float32": 1e-9, "float64": 1e-20}[dtype]
    # of both sides, mean over the axes
    np.testing.assert_allclose(found["magnitude"], 2 * 0.18 / 3, rtol=1e-5)


@pytest.mark.full
def test_a_wall_that_is_said_to_stand_still_does_not_look_right(monkeypatch, float64):
    found = wall_terms(monkeypatch, "float64", flow=np.zeros(3))
    assert found["warped"] > 1e-2  # squared sRGB
    assert found["flow"] > 0.3  # px, of two sides
    assert found["cycle"] == 0
    assert found["magnitude"] == 0


# --- the medium


def test_the_medium_starts_still_and_undecided(dtype):
    params = scene_flow.init(TINY, jax.random.key(0), FEATURES, jnp.dtype(dtype))
    point = jnp.asarray([0.3, -0.2, 0.9], dtype)
    sample = Sample(
        point, jnp.asarray([0.0, 0.6, 0.8], dtype), jnp.ones(FEATURES, dtype)
    )
    condition = FrameCondition(jnp.asarray(0.4, dtype), {}, jnp.asarray(0))
    found = scene_flow.medium(TINY, params, sample, condition)
    assert np.abs(found.extras["flow_forward"]).max() < 1e-3 * TINY.flow_bound
    assert np.abs(found.extras["disocclusion"]).max() < 1e-2
    assert abs(found.share) < 1e-2
    assert found.density >= 0


@pytest.mark.hard_cases
def test_what_is_surely_hidden_keeps_a_slope(dtype):
    params, frames, batch, arrays = scenario(dtype)
    sure = params._replace(
        disocclusion=params.disocclusion._replace(
            weight=np.zeros(params.disocclusion.weight.shape, dtype),
            bias=np.full(2, 40.0, dtype),
        )
    )

    @jax.jit
    @jax.value_and_grad
    def visible(params):
        context = context_of(TINY, params, frames, batch, *arrays, 0)
        found = scene_flow.neighbour(TINY, 1 / 3, params, context, scene_flow.FORWARD)
        return jnp.mean(found.visible)

    value, grad = visible(sure)
    np.testing.assert_allclose(value, np.exp(-40.0), rtol=2e-5)
    np.testing.assert_allclose(grad.disocclusion.bias, [-np.exp(-40.0), 0], rtol=2e-5)


@pytest.mark.hard_cases
def test_flow_stays_within_its_bound(dtype):
    params = scenario(dtype)[0]
    wild = params._replace(flow=params.flow._replace(bias=np.full(6, 1e4, dtype)))
    x = np.zeros(3, dtype)
    dynamic = jax.jit(scene_flow.dynamic, static_argnums=0)
    found = dynamic(TINY, wild, x, x, np.zeros((), dtype))
    np.testing.assert_allclose(found.flow, 0.3, rtol=1e-6)


def test_the_blending_says_what_width_it_was_built_for(float64):
    params = scenario("float64")[0]
    sample = Sample(jnp.zeros(3), jnp.zeros(3), jnp.zeros(FEATURES + 1))
    condition = FrameCondition(jnp.zeros(()), {}, jnp.asarray(0))
    with pytest.raises(ValueError, match=r"reads 7 features .* has 8"):
        scene_flow.medium(TINY, params, sample, condition)


@pytest.mark.parametrize(
    "make",
    [
        lambda: SceneFlowSpec(flow_bound=0.0),
        lambda: SceneFlowSpec(flow_bound=float("nan")),
        lambda: SceneFlowSpec(decay_steps=0),
        lambda: FlowWeights(cycle=-1.0),
        lambda: FlowWeights(depth=float("inf")),
    ],
)
def test_impossible_settings_are_refused(make):
    with pytest.raises(ValueError, match=r"=(-?\d|nan|inf)"):
        make()


# --- in a scene


@pytest.mark.slow  # 12 s of compilation
def test_a_scene_with_it_learns_from_pictures_depth_and_flow():
    capture = scenes.tiny_capture()
    spec = RadianceScene(
        steps=30,
        template=TINY.network,
        sampling=SamplingSpec(8, 0, block=100),
        rays=64,
        learning_rate=5e-3,
        learning_rate_end=1e-3,
        scene_flow=TINY,
    )
    metadata = scene.metadata_of(capture, spec)
    model = scene.build(spec, metadata)
    assert model.required_data == {"depths", "flow"}
    state = model.init(capture, jax.random.key(0))
    frames = evaluation.frames_of(capture, model.required_data)
    first, step, losses = state.params, jax.jit(model.step), []
    for _ in range(30):
        state, metrics = step(state, frames)
        losses.append(float(metrics["loss"]))
    assert {name for name in metrics if "/" in name} == {
        f"scene_flow/{name}" for name in NAMES
    }
    assert np.mean(losses[-5:]) < 0.7 * losses[0]
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), first, state.params)
    assert all(jax.tree.leaves(moved["scene_flow"]))
    both, still = (
        scene.field(spec, metadata, without) for without in ((), ("scene_flow",))
    )
    view = evaluation.view_of(capture, 0)
    pictures = [
        jax.jit(one.render, static_argnums=4)(
            state.params, view.camera, view.time, {}, (8, 6), state.step
        )
        for one in (both, still)
    ]
    assert all(np.isfinite(picture.colour).all() for picture in pictures)
    assert np.abs(pictures[0].colour - pictures[1].colour).max() > 1e-3
