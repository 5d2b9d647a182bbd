"""The time-varying medium: a loop over rays in NumPy, and the edges."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields.effects import scene_flow, timestamps
from nerfies_jax.fields.effects.effect import Sample
from nerfies_jax.fields.effects.scene_flow import FlowWeights
from nerfies_jax.nn.planes import PlanesSpec
from nerfies_jax.training.effects import FrameCondition
from tests import gradients, random_params, scene_flow_rays
from tests.scene_flow_rays import (
    BOX_SCALE,
    FEATURES,
    ROWS,
    TIMES,
    TIMESTAMPS,
    TINY,
    context_of,
    oracle,
    scenario,
)


@functools.partial(jax.jit, static_argnums=(0, 6))
def terms_of(spec, params, frames, batch, arrays, step, behind=None):
    context = context_of(spec, params, frames, batch, *arrays, step, behind)
    return scene_flow.penalty(spec, TIMES, params, context)


@pytest.mark.parametrize(
    ("step", "behind"), [(0, None), (250, None), (0, (0.9, 0.2, 0.6))]
)
def test_terms_are_sums_over_rays_and_samples_one_by_one(dtype, step, behind):
    inputs = scenario(dtype)
    terms = terms_of(TINY, *inputs, step, behind)
    expected = oracle(*inputs, step, behind)
    assert set(terms) == set(expected)
    for name, value in expected.items():
        # float32 rounds a few ulps of the coordinates, and divides by a deviation
        error = abs(float(terms[name].value) - value)
        assert error < {"float32": 3e-5, "float64": 1e-11}[dtype] * max(1, value), name


def test_weights_are_the_spec_s_and_the_capture_s_own_terms_fade(dtype):
    inputs = scenario(dtype)
    weights = dataclasses.asdict(TINY.weights)
    for step, fade in ((0, 1.0), (99, 1.0), (100, 0.1), (250, 0.01), (10**6, 0.0)):
        for name, term in terms_of(TINY, *inputs, step).items():
            expected = weights[name] * (fade if name in ("depth", "flow") else 1)
            np.testing.assert_allclose(term.weight, expected, rtol=1e-6, err_msg=name)


@pytest.mark.full
@pytest.mark.parametrize("step", [0, 250])
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


def test_terms_without_a_weight_or_data_are_not_there():
    inputs = scenario("float32")
    spec = dataclasses.replace(TINY, weights=FlowWeights(**dict.fromkeys(NAMES, 0.0)))
    assert terms_of(spec, *inputs, 0) == {}
    assert scene_flow.Bound(spec, TIMES).required_data == frozenset()
    only_flow = dataclasses.replace(spec, weights=FlowWeights(depth=0.0))
    assert scene_flow.Bound(only_flow, TIMES).required_data == {"flow"}
    assert scene_flow.Bound(TINY, TIMES).required_data == {"flow", "depths"}
    params, frames, batch, arrays = inputs
    bare = frames._replace(depths=None, flow=None)
    terms = jax.eval_shape(
        lambda *inputs: scene_flow.penalty(
            TINY, TIMES, params, context_of(TINY, *inputs)
        ),
        *(params, bare, batch, *arrays, 0),
    )
    assert set(terms) == set(NAMES) - {"depth", "flow"}


NAMES = tuple(field.name for field in dataclasses.fields(FlowWeights))


@pytest.mark.full
def test_a_flow_with_a_trunk_of_its_own_reads_nothing_of_the_medium_s(dtype):
    own = dataclasses.replace(TINY, flow_trunk=True)
    key, at = jax.random.key(0), jnp.asarray([0.1, -0.2, 0.3], dtype)
    start = jax.jit(scene_flow.init, static_argnums=(0, 2, 3))
    shared, apart = (
        start(spec, key, FEATURES, jnp.dtype(dtype)) for spec in (TINY, own)
    )

    def said(spec, params):
        return scene_flow.dynamic(spec, params, at, at, jnp.asarray(0.4, dtype))

    both = said(TINY, shared), said(own, apart)
    for name in ("density", "color", "disocclusion"):
        np.testing.assert_array_equal(*(getattr(one, name) for one in both))
    assert not np.array_equal(both[0].flow, both[1].flow)
    grad = jax.grad(lambda params: said(own, params).flow.sum())(apart)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(grad.network))
    assert all(np.any(leaf) for leaf in jax.tree.leaves(grad.flow_trunk))


# --- edges of time


@pytest.mark.full
def test_a_medium_on_planes_is_finite_outside_of_its_times(dtype):
    """As neighbors of the first and the last are, at any distance."""
    network = dataclasses.replace(
        TINY.network, position=PlanesSpec(3, (1, 2), timestamps=4, features=2)
    )
    spec = dataclasses.replace(TINY, network=network)
    params = random_params.like(
        lambda key: scene_flow.init(spec, key, FEATURES, jnp.dtype(dtype)), dtype, 0.1
    )

    @jax.jit
    @functools.partial(jax.value_and_grad, argnums=(0, 1, 2))
    def total(params, point, time):
        one = scene_flow.dynamic(spec, params, point, jnp.ones_like(point), time)
        return sum(jnp.sum(leaf) for leaf in one)

    for place, time in itertools.product((0.3, 1e6), (-1 / 3, 0.0, 1.0, 4 / 3)):
        actual = total(params, np.full(3, place, dtype), np.asarray(time, dtype))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(actual))
        tables = actual[1][0].network.tables
        assert all(np.any(plane) for plane in jax.tree.leaves(tables))


@functools.partial(jax.jit, static_argnums=4)
def slopes_of(params, frames, batch, arrays, times):
    """Slopes of all terms in parameters and in what the medium says, and the terms."""
    medium = context_of(TINY, params, frames, batch, *arrays, 0).levels[0].media

    def total(params, shift):
        context = context_of(TINY, params, frames, batch, *arrays, 0)
        level = context.levels[0]
        own = level.media["scene_flow"]
        own = own._replace(extras=jax.tree.map(jnp.add, own.extras, shift))
        level = level._replace(media={"scene_flow": own})
        terms = scene_flow.penalty(
            TINY, times, params, context._replace(levels=(level,))
        )
        return sum(term.value for term in terms.values()), terms

    shift = jax.tree.map(jnp.zeros_like, medium["scene_flow"].extras)
    return jax.grad(total, (0, 1), has_aux=True)(params, shift)


@pytest.mark.full
def test_the_first_and_the_last_time_have_one_neighbor(float64):
    (_, grad), _ = slopes_of(*scenario("float64"), TIMES)
    strength = {name: np.abs(np.asarray(x)).sum((1, -1)) for name, x in grad.items()}
    rows = np.array(ROWS)
    for name, missing in (("flow_forward", TIMESTAMPS - 1), ("flow_backward", 0)):
        assert (strength[name][rows == missing] == 0).all()
        assert (strength[name][rows != missing] > 0).all()
    hidden = np.abs(np.asarray(grad["disocclusion"])).sum(1)  # rays, sides
    assert (hidden[rows == TIMESTAMPS - 1, 0] == 0).all()
    assert (hidden[rows == 0, 1] == 0).all()


@pytest.mark.full
def test_a_single_time_has_no_neighbors_and_no_flow_to_learn(dtype):
    params, frames, batch, arrays = scenario(dtype)
    still = frames._replace(times=np.zeros(TIMESTAMPS, dtype))
    slopes_and_terms = slopes_of(params, still, batch, arrays, (0.0,))
    (grad, _), terms = jax.tree.map(np.asarray, slopes_and_terms)
    for name in ("warped", "cycle", "disocclusion", "magnitude", "kinetic", "flow"):
        assert terms[name].value == 0, name
    assert terms["dynamic"].value > 0
    assert (grad.flow.weight == 0).all()
    assert (grad.flow.bias == 0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grad))


@pytest.mark.parametrize("held_out", [2, 3, 8])
def test_neighbors_are_times_that_were_observed(held_out, dtype):
    """And not those that lie an interval away, where no image says what is seen."""
    every_time = np.arange(40) / 39
    learned = np.delete(every_time, np.arange(0, 40, held_out)).astype(np.float32)
    times = tuple(float(time) for time in learned)
    beside = jax.jit(timestamps.neighbor, static_argnums=(0, 2))
    now = jnp.asarray(learned, dtype)
    for sign in scene_flow.SIGNS:
        actual, present = beside(times, now, sign)
        places = np.arange(len(learned)) + sign
        inside = (places >= 0) & (places < len(learned))
        np.testing.assert_array_equal(present, inside)
        np.testing.assert_array_equal(
            np.asarray(actual)[inside], learned[places[inside]].astype(dtype)
        )


# --- the medium


def test_the_medium_starts_still_and_undecided(dtype):
    point = jnp.asarray([0.3, -0.2, 0.9], dtype)
    direction = jnp.asarray([0.0, 0.6, 0.8], dtype)
    sample = Sample(point, direction, jnp.asarray([1.0] * FEATURES, dtype))
    condition = FrameCondition(jnp.asarray(0.4, dtype), {}, jnp.int32(0))

    @jax.jit
    def start(key):
        params = scene_flow.init(TINY, key, FEATURES, jnp.dtype(dtype))
        return scene_flow.medium(TINY, params, sample, condition)

    start_medium = jax.tree.map(np.asarray, start(jax.random.key(0)))
    assert np.abs(start_medium.extras["flow_forward"]).max() < 1e-3 * TINY.flow_bound
    assert np.abs(start_medium.extras["disocclusion"]).max() < 1e-2
    assert abs(start_medium.share) < 1e-2
    assert start_medium.density >= 0


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
        there = scene_flow.neighbor(TINY, TIMES, params, context, scene_flow.FORWARD)
        return jnp.mean(there.visible)

    value, grad = visible(sure)
    np.testing.assert_allclose(value, np.exp(-40.0), rtol=2e-5)
    np.testing.assert_allclose(grad.disocclusion.bias, [-np.exp(-40.0), 0], rtol=2e-5)


@pytest.mark.hard_cases
def test_flow_stays_within_its_bound(dtype):
    params = scenario(dtype)[0]
    wild = params._replace(flow=params.flow._replace(bias=np.full(6, 1e4, dtype)))
    x = np.zeros(3, dtype)
    dynamic = jax.jit(scene_flow.dynamic, static_argnums=0)
    sample = dynamic(TINY, wild, x, x, np.zeros((), dtype))
    np.testing.assert_allclose(sample.flow, 0.3, rtol=1e-6)


def test_the_blending_says_what_width_it_was_built_for():
    params, wide = scenario("float32")[0], np.zeros(FEATURES + 1, np.float32)
    nowhere = jnp.asarray(np.zeros(3, np.float32))
    sample = Sample(nowhere, nowhere, jnp.asarray(wide))
    condition = FrameCondition(jnp.float32(0), {}, jnp.int32(0))
    with pytest.raises(ValueError, match=r"reads 7 features.* has 8"):
        scene_flow.medium(TINY, params, sample, condition)


def chain_by_hand(params, frames, batch, arrays, step):
    """The error two timestamps away as a sum over rays, by the oracle's network."""
    params, frames, batch = jax.tree.map(
        lambda x: np.asarray(x, np.float64) if x.dtype.kind == "f" else np.asarray(x),
        (params, frames, batch),
    )
    distances, _, blend_weight = (np.asarray(x, np.float64) for x in arrays)
    side, sign = step % 2, (1, -1)[step % 2]
    errors = []
    for r, row in enumerate(ROWS):
        if not (0 <= row + 2 * sign < TIMESTAMPS and batch.valid[r]):
            continue
        origin = (batch.origin[r] - scene_flow_rays.BOX_CENTER) * BOX_SCALE
        points = [origin + d * batch.direction[r] for d in distances[r]]
        for k in (row, row + sign):
            gap = abs(TIMES[k + sign] - TIMES[k]) * (TIMESTAMPS - 1)
            flows = [
                scene_flow_rays.dynamic(params, x, batch.direction[r], TIMES[k])[2]
                for x in points
            ]
            points = [x + gap * f[side] for x, f in zip(points, flows, strict=True)]
        there = [
            scene_flow_rays.dynamic(params, x, batch.direction[r], TIMES[k + sign])
            for x in points
        ]
        weight = scene_flow_rays.composite([t[0] for t in there], distances[r], None)
        color = sum(w * t[1] for w, t in zip(weight, there, strict=True))
        error = np.mean((color - batch.color[r]) ** 2)
        errors.append((error, blend_weight[r].sum()))
    return scene_flow_rays.weighted(errors)


@pytest.mark.full
@pytest.mark.parametrize("step", [200, 201])
def test_a_chain_leads_two_timestamps_on_in_turn_to_either_side(dtype, step):
    params, frames, batch, arrays = inputs = scenario(dtype)
    weights = FlowWeights(**dict.fromkeys(NAMES, 0.0) | {"warped": 0.5})
    spec = dataclasses.replace(TINY, weights=weights, chain_steps=200)
    term = terms_of(spec, *inputs, step)["chain"]
    expected = chain_by_hand(params, frames, batch, arrays, step)
    bound = {"float32": 3e-5, "float64": 1e-11}[dtype]
    np.testing.assert_allclose(term.value, expected, rtol=bound)
    assert term.weight == 0.5
    assert terms_of(spec, *inputs, 199)["chain"].value == 0
    assert "chain" not in terms_of(TINY, *inputs, step)


@pytest.mark.full
def test_a_chain_has_the_slope_of_its_differences(float64):
    params, frames, batch, arrays = scenario("float64")
    spec = dataclasses.replace(TINY, chain_steps=0)

    def loss(params):
        return terms_of(spec, params, frames, batch, arrays, 200)["chain"].value

    assert gradients.directional_error(loss, params, step=1e-6) < 1e-6
